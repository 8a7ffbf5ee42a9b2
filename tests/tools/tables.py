"""Markdown tables as they are read, whatever the width of their columns."""

import re


def squeezed(text: str) -> str:
    """The text with one space for several."""
    return re.sub(' +', ' ', text)
