"""The root of the error tree.

It lives in the lowest room, so that every room can raise an error that the command line turns
into one clear line and an exit code.
"""


class VisctrlError(Exception):
    """Anything this software reports to its user without a traceback."""

    exit_code = 1


class InputError(VisctrlError, ValueError):
    """A file, key, option or image that cannot be used.

    Examples: an unknown key in a scenario, a robot that does not exist, a start inside a wall,
    a target image of another camera. The message names the thing and the remedy; nothing has
    been started.
    """

    exit_code = 2


class DiskError(VisctrlError):
    """What shall be kept cannot be written, for want of room or of a working disk.

    Examples: no space left, a quota used up, a broken medium. Another name would not help.
    """

    exit_code = 3


class LoadError(VisctrlError):
    """The code of an extension fails while it is imported.

    Examples: a syntax error, a name that is not defined, a module that ends the program.
    """

    exit_code = 3
