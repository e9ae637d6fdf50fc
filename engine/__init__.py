"""The science: photos → cameras → Gaussians → features → probability → fruits → files. Never imports bpy."""

import os

# Before anything below loads torch: its OpenMP threads and Numba's would otherwise spin against each other for the
# cores between two parallel regions, which costs many times the work itself on a busy machine.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
