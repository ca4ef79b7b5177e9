"""The error tree of the hardware layer. Vendor errors are wrapped, never leaked."""

from visctrl.robots.errors import InputError, VisctrlError

__all__ = [
    "BaseFaultError",
    "CameraError",
    "DeviceError",
    "InputError",
    "LinkError",
    "StaleFrameError",
    "VisctrlError",
]


class DeviceError(VisctrlError):
    """A device is missing, busy, silent or broken."""

    exit_code = 3


class LinkError(DeviceError):
    """The line to the base fails.

    Examples: the port does not exist or is busy, nothing answers, reports stop coming.
    """


class CameraError(DeviceError):
    """The camera delivers nothing usable.

    Examples: no such device, the stream ended, frames of another size than the calibration's.
    """


class StaleFrameError(CameraError):
    """The newest frame is older than allowed: the camera has frozen."""


class BaseFaultError(DeviceError):
    """The base reports that it cannot go on.

    Examples: stalled wheel, bumper pressed, emergency stop, motors disabled, low battery.
    """
