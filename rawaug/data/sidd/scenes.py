"""SIDD's scene instances: the fields of their names, and which are held back for validation and benchmark.

The pattern goes by phone (the dataset's ``bayer_patterns.csv``). The S6's is GRBG; it looks like GBRG to those who read
the files of version 7.3 without exchanging the axes. Source: A. Abdelhamed, S. Lin, M. S. Brown, "A high-quality
denoising dataset for smartphone cameras", CVPR 2018.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from rawaug.bayer import CFA

PHONES = {
    "GP": ("Google Pixel", CFA.BGGR),
    "IP": ("Apple iPhone 7", CFA.RGGB),
    "S6": ("Samsung Galaxy S6 Edge", CFA.GRBG),
    "N6": ("Motorola Nexus 6", CFA.BGGR),
    "G4": ("LG G4", CFA.BGGR),
}
"""Code in the folder's name: the phone, and the pattern of its frames."""

_NAME = re.compile(r"(\d{4})_(\d{3})_([A-Z0-9]{2})_(\d{5})_(\d{5})_(\d{4})_([LNH])")


@dataclass(frozen=True)
class SiddScene:
    """A scene instance, parsed from its folder's name: number, physical scene, phone, ISO and illuminant (kelvin)."""

    name: str
    instance: int
    scene: int
    phone: str
    iso: int
    kelvin: int

    @classmethod
    def parse(cls, name: str) -> SiddScene:
        """From the folder's name.

        Raises:
            ValueError: if it is not a scene instance's name, or the phone is unknown.

        Example:
            >>> SiddScene.parse("0052_002_S6_01600_01000_5500_N").cfa
            <CFA.GRBG: 'GRBG'>
        """
        found = _NAME.fullmatch(name)
        if found is None or found[3] not in PHONES:
            raise ValueError(f"{name}: is not a SIDD scene instance such as 0052_002_S6_01600_01000_5500_N")
        return cls(name, int(found[1]), int(found[2]), found[3], int(found[4]), int(found[6]))

    @property
    def cfa(self) -> CFA:
        return PHONES[self.phone][1]

    @property
    def camera(self) -> str:
        return PHONES[self.phone][0]


def is_scene(name: str) -> bool:
    """Whether a folder's name is that of a scene instance."""
    return _NAME.fullmatch(name) is not None


HELD_BACK = (
    "0009_001_S6_00800_00350_3200_L", "0021_001_GP_10000_05000_5500_N", "0024_001_N6_03200_01500_5500_N",
    "0026_001_G4_00400_00160_5500_L", "0031_001_IP_01600_02000_3200_N", "0037_002_GP_06400_03200_3200_L",
    "0041_002_IP_01600_04000_5500_L", "0046_002_G4_00400_00350_3200_L", "0049_002_N6_00800_00800_5500_L",
    "0053_002_S6_03200_02000_5500_N", "0056_003_N6_03200_04000_5500_N", "0058_003_G4_00400_00500_5500_L",
    "0061_003_S6_00800_00500_4400_L", "0067_003_GP_01600_01500_3200_L", "0071_003_IP_02000_04000_5500_L",
    "0074_004_N6_00400_00040_3200_L", "0079_004_G4_00800_00160_3200_N", "0082_004_S6_03200_00500_4400_L",
    "0085_004_GP_06400_02000_4400_N", "0093_004_IP_01250_00250_3200_L", "0095_005_N6_00400_00200_3200_L",
    "0100_005_G4_00800_00400_3200_N", "0103_005_S6_01600_00800_4400_L", "0109_005_GP_10000_08000_4400_N",
    "0112_005_IP_01000_07500_5500_L", "0119_006_N6_00400_00100_3200_L", "0124_006_G4_00800_00350_3200_N",
    "0128_006_S6_03200_01600_4400_L", "0131_006_GP_01600_01250_4400_N", "0141_006_IP_01600_01620_3200_L",
    "0143_007_N6_00800_00800_4400_N", "0148_007_G4_00400_00400_4400_L", "0153_007_S6_03200_03200_5500_L",
    "0158_007_GP_03200_03200_5500_N", "0162_007_IP_01600_01600_3200_L", "0171_008_N6_03200_01600_4400_L",
    "0174_008_G4_00800_00800_4400_N", "0176_008_S6_00400_00100_5500_L", "0183_008_GP_06400_06400_5500_N",
    "0187_008_IP_01600_01600_3200_L",
)  # fmt: skip
"""The scene instances of the blocks of validation and benchmark, in their order; none is among those for training."""
