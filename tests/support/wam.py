"""The shipped arm as tests need it: its joints' names, its description, and the layouts of what is
recorded of it.
"""

from __future__ import annotations

from thirdhand.core.frame import frame_layout, state_layout
from thirdhand.settings.config import WAM, Settings

JOINT_NAMES = Settings().joints.names
URDF = WAM.read_text(encoding="utf-8")
FRAME = frame_layout(len(JOINT_NAMES))
STATE = state_layout(len(JOINT_NAMES))
