"""Shape annotations are checked at run time in tests.

Each worker has one thread, because two workers share two cores.
"""

import os

from jaxtyping import install_import_hook

os.environ.setdefault("OMP_NUM_THREADS", "1")
install_import_hook("skyproof", "beartype.beartype")

import torch  # noqa: E402

torch.set_num_threads(1)
