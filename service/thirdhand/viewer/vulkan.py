"""The number of Vulkan devices of this machine; the viewer draws a picture without a screen only
where there is one.
"""

from __future__ import annotations

import ctypes
import subprocess
import sys
from pathlib import Path

CREATE_INSTANCE = 1  # VK_STRUCTURE_TYPE_INSTANCE_CREATE_INFO


class InstanceCreateInfo(ctypes.Structure):
    """VkInstanceCreateInfo without layers and extensions."""

    _fields_ = (
        ("type", ctypes.c_uint32),
        ("next", ctypes.c_void_p),
        ("flags", ctypes.c_uint32),
        ("application", ctypes.c_void_p),
        ("layers", ctypes.c_uint32),
        ("layer_names", ctypes.c_void_p),
        ("extensions", ctypes.c_uint32),
        ("extension_names", ctypes.c_void_p),
    )


def devices() -> int:
    """The number of physical devices, software renderers included; 0 without loader or driver."""
    try:
        vulkan = ctypes.CDLL("libvulkan.so.1")
    except OSError:
        return 0
    instance = ctypes.c_void_p()
    count = ctypes.c_uint32()
    if (
        vulkan.vkCreateInstance(
            ctypes.byref(InstanceCreateInfo(CREATE_INSTANCE)), None, ctypes.byref(instance)
        )
        != 0
    ):
        return 0
    result = vulkan.vkEnumeratePhysicalDevices(instance, ctypes.byref(count), None)
    return count.value if result == 0 else 0


def is_there() -> bool:
    """True if a device is found. A separate process asks, as drivers load their own libraries."""
    if not sys.platform.startswith("linux"):
        return True  # elsewhere the viewer draws by the system's own interface
    program = Path(__file__).read_text(encoding="utf-8") + "\nprint(devices())"
    process = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False
    )
    return process.stdout.strip() not in {"", "0"}
