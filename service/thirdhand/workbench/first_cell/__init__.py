"""A first cell for an arm: from its URDF to settings, posture, rates and a picture."""
