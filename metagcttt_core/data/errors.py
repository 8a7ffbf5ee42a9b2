"""Errors of external data."""


class DatasetError(ValueError):
    """A dataset that cannot be used; the message names the file, the field and the row."""
