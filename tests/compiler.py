"""Compiler flags of the tests. Import this module before JAX.

Most of the suite's time is XLA's compiler. With these flags it takes a fifth of the time; the
programs are slower, which short ones do not notice. Flags of the user stay.
"""

import os

os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
os.environ.setdefault(
    "XLA_FLAGS",
    "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true "
    "--xla_cpu_use_fusion_emitters=false",
)
