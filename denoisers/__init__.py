"""RAW denoisers: networks, classical methods, self-ensemble, tiles, files of weights.

Each of them is called as ``model(noisy, variance=None) -> denoised``. All three tensors are packed RAW ``(B, 4, h, w)``
in the order R, Gr, Gb, B.
"""

from denoisers.cascade import CascadeDRUNet
from denoisers.classical import BM3D, NonLocalMeans, Stabilised, TotalVariation, Wavelet
from denoisers.cycleisp import CycleISPDenoiser
from denoisers.dhdn import DHDN
from denoisers.dncnn import DnCNN
from denoisers.drunet import DRUNet
from denoisers.ensemble import SelfEnsemble
from denoisers.ffdnet import FFDNet
from denoisers.files import build, from_pretrained, load, save
from denoisers.glide import GLIDE
from denoisers.joint import JointDRUNet
from denoisers.ksvd import KSVD
from denoisers.mean import MeanDRUNet
from denoisers.mosaic import MosaicDRUNet
from denoisers.nafnet import NAFNet
from denoisers.network import DENOISERS, Denoiser
from denoisers.pmrid import PMRID
from denoisers.tiles import denoise_tiles
from denoisers.tnrd import TNRD
from denoisers.unet import UNet
from denoisers.wnnm import WNNM

__all__ = [
    "BM3D", "DENOISERS", "DHDN", "GLIDE", "KSVD", "PMRID", "TNRD", "WNNM", "CascadeDRUNet", "CycleISPDenoiser",
    "DRUNet", "Denoiser", "DnCNN", "FFDNet", "JointDRUNet", "MeanDRUNet", "MosaicDRUNet", "NAFNet", "NonLocalMeans",
    "SelfEnsemble", "Stabilised", "TotalVariation", "UNet", "Wavelet", "build", "denoise_tiles", "from_pretrained",
    "load", "save",
]  # fmt: skip
