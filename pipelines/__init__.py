"""Jobs in one process or on Ray. The only package that imports ray."""

import os

# A worker has one core; by default libigl starts one thread for each core of the machine in every worker.
os.environ.setdefault("IGL_NUM_THREADS", "1")
# Silences a warning of Ray about accelerators, which no step uses.
os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
