"""One thread a process, for two processes test at once (``make test``); the children of a test inherit it."""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import torch

torch.set_num_threads(1)
