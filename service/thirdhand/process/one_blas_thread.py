"""Import this before NumPy: it sets one BLAS thread for this process and its children.

With more threads, results depend on the load of the machine. Every entry point imports it first.
"""

import os

for _library in ("OPENBLAS", "OMP", "MKL"):
    os.environ[f"{_library}_NUM_THREADS"] = "1"
