"""The one exception type that is shown to users."""


class DeltalightError(Exception):
    """A fault that the user can fix: the message says in one sentence what is wrong and what to do.

    The command line prints it without a traceback and exits with code 2.
    """
