"""Where and how many: jobs on Ray. The only package that imports ray."""

import os

# One worker is one core: libigl would otherwise start as many threads in each worker as the machine has cores.
os.environ.setdefault("IGL_NUM_THREADS", "1")
# Ray would warn of a change in how it treats accelerators, which no step uses.
os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
