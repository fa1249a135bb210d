"""A stand-in for the classes of LeRobot 0.4.4 that a plug-in uses, where it is not installed: with
PyTorch, it needs gigabytes.
"""
