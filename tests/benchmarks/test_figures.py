"""docs/figures.md is what the rows say."""

from benchmarks.figures import PAGE, page


def test_the_page_is_what_the_generator_makes() -> None:
    text = page()
    assert PAGE.read_text(encoding="utf-8") == text, "run `farside bench figures`"
    assert text.count("**FAIL**") > 20 and "Transcribed from" in text
