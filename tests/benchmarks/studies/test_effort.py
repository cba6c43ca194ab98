"""The easy and the hard scenes are what they are called."""

import pytest

from benchmarks.studies.effort import EASY, HARD, scenes
from probnerf.objects.tabletop import KINDS, TEXTURES


@pytest.mark.slow
def test_an_easy_scene_hides_less_than_a_hard_one() -> None:
    easy, hard = next(scenes(EASY, 1)), next(scenes(HARD, 1))
    assert (KINDS[int(easy.shape.kind)], TEXTURES[int(easy.shape.texture)]) == ("can", "plain")
    assert (KINDS[int(hard.shape.kind)], TEXTURES[int(hard.shape.texture)]) == ("pitcher", "printed")
    assert not bool(easy.shape.has_handle)
    assert easy.segment.occluder.sum() < 0.01 * hard.segment.occluder.sum()
    assert set(easy.frame.label.ravel()) == {0, 1} and set(hard.frame.label.ravel()) == {0, 1, 2}
