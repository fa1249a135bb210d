"""Child processes, interrupts, one BLAS thread, and the progress that commands print."""
