"""The shipped arm for tests: joint names, description, and layouts of its recorded state and
frame.
"""

from __future__ import annotations

from thirdhand.core.frame import frame_layout, state_layout
from thirdhand.settings.config import WAM, Settings

JOINT_NAMES = Settings().joints.names
URDF = WAM.read_text(encoding="utf-8")
FRAME = frame_layout(len(JOINT_NAMES))
STATE = state_layout(len(JOINT_NAMES))
