"""The errors a user can meet; the command line prints them as one line and exits with 1."""


class TaaError(Exception):
    """Something the user can act on: what is wrong; what to do."""


class Refused(TaaError):
    """The pipeline looked at the data and declines to answer; the message says why."""
