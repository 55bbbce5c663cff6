r"""Settings of an ISP, drawn at random without looking at the pictures.

One draw is a camera in a light (:mod:`rawaug.camera.samplers`), a mixture of tone curves and an exposure,

.. math:: y = h(C\,T(x);\, g \, 2^{-e}), \quad T = \textstyle\sum_k v_k T_k

with h Brooks' highlight-preserving inverse gains, a mixture v of up to three inverse tone curves, and e in stops. Of an
ISP that was fitted to frames it is a convex combination of its atoms (Conde et al., AAAI 2022, "Dictionary
augmentations").
"""

from __future__ import annotations

from rawaug.camera.lights import light_range
from rawaug.camera.own import own_cameras
from rawaug.camera.samplers import CameraSampler, DataSheetSampler
from rawaug.isp.config import ISPParams
from rawaug.isp.dictionary import CameraDictionary, convex_weights
from rawaug.isp.model import DictionaryISP
from rawaug.seeding import Generators

EXPOSURE = (-0.5, 1.0)
"""Limits of the uniform draw in stops. The headroom that cameras leave between the white of RAW and that of their
pictures is not published. With these the mean RAW of photographs is 0.136, and 71 % of the cells whose green is clipped
have red to spare, as in real files; with a ceiling of 1.5 stops it is 45 %."""


def draw_setting(
    isp: DictionaryISP, batch: int, generator: Generators, cameras: CameraSampler | None = None
) -> ISPParams:
    """Draw the settings of ``batch`` pictures, at exposure 0.

    If the atoms are published cameras, it draws a camera in a light, else mixtures of atoms with uniform weights.

    Args:
        isp: the ISP.
        batch: number of pictures.
        generator: a generator on the CPU, or one for each picture.
        cameras: what :func:`camera_sampler` has made, to draw from it many times.
    """
    config, device = isp.config, isp.colour.matrices.device
    cameras = cameras or camera_sampler(isp)
    if cameras is None:
        weights = []
        for atoms in (config.colour_atoms, config.gain_atoms, config.tone_atoms):
            if atoms:
                weights.append(convex_weights(batch, atoms, generator).to(device))
        return isp.params_from_weights(*weights)

    colour_weights, matrix, gains = (tensor.to(device) for tensor in cameras.sample(batch, generator))
    tones = no_weights = gains[:, :0]  # the gains follow from the light
    if isp.tone is not None:
        tones = isp.tone.draw(batch, generator)
    return ISPParams(colour_weights, no_weights, matrix, gains, tones)


def camera_sampler(
    isp: DictionaryISP, consistent: bool = True, light: float | str | None = None
) -> CameraSampler | None:
    """Make the sampler that draws cameras in a light; None unless the colour atoms are published cameras.

    Later changes to the atoms do not affect it.

    Args:
        isp: the ISP.
        consistent: whether colour and gains are of one camera in one light; if not, gains are drawn separately.
        light: a colour temperature in kelvin or one of :data:`rawaug.camera.lights.LAMPS`; any light by default.
    """
    if not isinstance(isp.colour, CameraDictionary):
        return None

    atoms = isp.colour.known, isp.colour.atoms(), isp.colour.responses()
    sheets = own_cameras(isp.info)
    if sheets:
        return DataSheetSampler(sheets, *atoms, light, consistent)
    return CameraSampler(*atoms, light_range(light), consistent)
