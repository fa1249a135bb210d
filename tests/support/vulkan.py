"""How many devices Vulkan finds, without which the viewer draws nothing off screen; as a program,
prints it.
"""

from __future__ import annotations

import ctypes

CREATE_INSTANCE = 1  # VK_STRUCTURE_TYPE_INSTANCE_CREATE_INFO


class InstanceCreateInfo(ctypes.Structure):
    """VkInstanceCreateInfo, but for layers and extensions, of which none is asked for."""

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
    instance, count = ctypes.c_void_p(), ctypes.c_uint32()
    if vulkan.vkCreateInstance(ctypes.byref(InstanceCreateInfo(CREATE_INSTANCE)), None, ctypes.byref(instance)) != 0:
        return 0
    found = vulkan.vkEnumeratePhysicalDevices(instance, ctypes.byref(count), None)
    return count.value if found == 0 else 0


if __name__ == "__main__":
    print(devices())
