from __future__ import annotations

import pytest
import torch

from rawaug.kernels.runtime import find_device


@pytest.mark.usefixtures("no_gpu")
def test_devices_are_found_or_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    assert find_device("auto") == find_device("cpu") == torch.device("cpu")
    for name in ("cuda", "gpu", "mps", "cuda:0"):
        with pytest.raises(ValueError, match=f"{name}.*cpu or auto"):
            find_device(name)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    assert find_device("auto") == find_device("gpu") == torch.device("cuda")
    assert find_device("cuda:1") == torch.device("cuda", 1)
    for name, count in (("cuda:2", 1), ("cuda", 3)):
        with pytest.raises(ValueError, match="this machine has 2"):
            find_device(name, count=count)
    for name in ("cudaa", "cuda:one", ""):
        with pytest.raises(ValueError, match="auto"):
            find_device(name)
