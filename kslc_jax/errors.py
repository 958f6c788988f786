"""Errors that a user can mend: a command prints their message in one line and ends."""


class UserError(Exception):
    """Base class; `exit_code` is the command's."""

    exit_code = 2


class MissingPackage(UserError, ImportError):
    """A package that is optional and not installed; the message says how to install it."""
