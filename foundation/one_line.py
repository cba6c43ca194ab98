"""Errors of libraries as one line."""


def one_line(error: BaseException) -> str:
    """The error's message without line breaks; its type's name where there is no message."""
    return " ".join(str(error).split()) or type(error).__name__
