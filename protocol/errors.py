"""The one exception type that reaches users as a sentence."""


class DeltalightError(Exception):
    """A fault that a user can mend: the message says in one sentence what is wrong and what to do.

    The command line prints it without a traceback and exits with code 2.
    """
