"""The few errors and the one warning that pcfix raises for a user's mistake.

Each message is one sentence that a person can act on: the file, the value, the rule, the remedy.
"""


class PcfixError(Exception):
    """Anything that a user can mend; the command line prints it and exits with 1."""


class InputError(PcfixError):
    """A file that is missing, damaged or not what it should be."""


class SettingError(PcfixError, ValueError):
    """An option or argument outside its rule."""


class GeometryError(PcfixError):
    """Cloud, cameras and water that do not fit together."""


class PcfixWarning(UserWarning):
    """Something that was done on the user's behalf and that they should know of."""
