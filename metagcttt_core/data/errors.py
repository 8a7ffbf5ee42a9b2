"""Errors of data that comes from outside."""


class DatasetError(ValueError):
    """A dataset that cannot be used; the message names the file, the field and the row."""
