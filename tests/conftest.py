"""Settings for every test; nothing of this project is imported here, so that the shape checks see each module first."""

import torch
from hypothesis import settings

# The same examples in every run, however busy the machine is.
settings.register_profile("suite", deadline=None, derandomize=True, database=None, print_blob=True)
settings.load_profile("suite")

# Tensors are tiny here: a second thread costs more than it brings, above all when tests run in parallel.
torch.set_num_threads(1)
