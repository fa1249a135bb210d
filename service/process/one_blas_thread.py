"""Import this before NumPy: one BLAS thread, in this process and those that it starts.

More would make results depend on how busy the machine is. Every entry point imports it first.
"""

import os

for _library in ("OPENBLAS", "OMP", "MKL"):
    os.environ[f"{_library}_NUM_THREADS"] = "1"
