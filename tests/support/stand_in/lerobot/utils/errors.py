"""Errors of devices."""


class DeviceNotConnectedError(ConnectionError):
    """A device is not connected."""


class DeviceAlreadyConnectedError(ConnectionError):
    """A device is connected already."""
