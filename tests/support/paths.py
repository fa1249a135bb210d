"""Paths of the project's folders."""

from pathlib import Path

import kmp

ROOT = Path(__file__).parents[2]
ARMS = ROOT / "service" / "thirdhand" / "arms"  # shipped arms and their cells
RECORDINGS = ROOT / "recordings"
LIBRARY = Path(kmp.__file__).parents[1]  # where `import kmp` finds it
