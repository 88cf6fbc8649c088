"""Every exception raised on purpose.

MavquadError
 +-- ConfigError     a file or an option that a person wrote is wrong
 +-- WireError       bytes that are not the MAVLink frame they claim to be
 +-- LinkError       a message, an endpoint or a peer that is not as expected
 +-- LogError        a recorded file that cannot be read or written
 +-- FlightError     the flight cannot begin or go on

Each message is one line: what, where, got, expected, next move. `tools/__main__.py` alone prints them.
"""


class MavquadError(Exception):
    """The root: a command that meets one prints it as one line and exits with 1."""


class ConfigError(MavquadError):
    """A file, a parameter or an option that a person wrote is wrong."""


class WireError(MavquadError):
    """Bytes that are not the MAVLink frame they claim to be."""


class LinkError(MavquadError):
    """A message, an endpoint or a peer that is not as expected."""


class LogError(MavquadError):
    """A recorded file that cannot be read or written."""


class FlightError(MavquadError):
    """The flight cannot begin or go on."""
