"""The settings of a recipe: a dataclass for each part, which explains every key and gives its type."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Annotated, Any, ClassVar, Literal

from annotated_types import Interval
from pydantic import BeforeValidator

from rawaug.data.frames import OWN_PICTURES
from rawaug.data.pair_folder import PairSettings
from rawaug.data.pairs import Pair
from rawaug.experiment.folder import require_folder_name
from rawaug.files import find_weights, fingerprint, sha256
from rawaug.isp.fit import FitConfig
from rawaug.isp.model import DictionaryISP
from rawaug.kernels.runtime import find_device
from rawaug.noise import noise_model
from rawaug.plugin.draw import Draw
from rawaug.plugin.targets import Srgb, Target
from rawaug.registry import require_bounds, split_spec
from rawaug.training.config import MOST, Count, DenoiserConfig, Rate, TrainConfig, Weighing
from rawaug.training.estimators import ESTIMATORS
from rawaug.training.srgb_noise import noise_on_srgb
from rawaug.training.srgb_samples import Conditioning

_SHORT_CROP = 256
"""Side in pixels of the middles of frames that a dry run uses."""

_NOT_OF_WEIGHTS = (
    *("name", "out", "device", "devices", "seed", "seeds", "steps", "arms", "isp", "fit"),
    *("views", "self_ensemble", "classical", "baselines"),
)
"""Keys on which no weights depend, or which count through the arm, the seed and the ISP."""

HELD_OUT = "auto"
"""The value of ``data.validation`` for a part of ``data.pairs``."""

_USUAL = "usual"
"""The value of ``data.validation`` that :class:`DataConfig` replaces by the one that suits ``data.pairs``."""

_DEMO = "demo:"
"""The beginning of the names of built-in, simulated frames."""

_PAIRS = "pairs:"


def _require_noise_form(value: Any) -> Any:
    """Refuse anything but a name, a list or a mapping, in the words of :func:`rawaug.noise.noise_model`."""
    if not isinstance(value, (str, list, tuple, Mapping)):
        noise_model(value)
    return value


Share = Annotated[float, Interval(ge=0.0, le=1.0)]
"""A share of samples."""

Side = Annotated[int, Interval(ge=32, le=MOST)]
"""The side of the middle of a frame, in pixels."""

NoiseSetting = Annotated[
    tuple[float, float] | str | Sequence[str | dict[str, Any]] | dict[str, Any], BeforeValidator(_require_noise_form)
]
"""The noise of a recipe, as :func:`rawaug.noise.noise_model` takes it."""


@dataclass
class DataConfig(PairSettings):
    """The settings of the data: where pictures come from.

    Args:
        pairs: the few real RAW-sRGB pairs: a folder of RAW files, or ``kind:path``, such as ``pairs:PATH`` for
            noisy/clean pairs; null for none.
        count: number of pairs to use; null for all.
        select: which pairs to use: first; scenes, whole ones; phones, as many of each; or a list of names of frames or
            their folders.
        crop: side of the central crop used of each of these pairs; null for the whole frame. Fewer pixels than a
            network has parameters are a regime in which further samples can help.
        pictures: the sRGB pictures to augment with: a folder, ``demo:``, ``shapes:COUNT``, a list of these, or
            ``pairs``, those of the chosen pairs.
        memory_mb: size in megabytes of the cache of decoded pictures.
        max_pixels: larger pictures, including those of pairs and PNG mosaics, are refused; null for 2^26.
        validation: validation pairs, of which self-supervised arms see only the noisy frames; auto holds out the last
            fifth of ``pairs``, at most 16, which nothing else then sees; null validates on RAW made from the pictures
            and keeps the final weights; usual is demo:validation if ``pairs`` is the demo's or null, else auto.
        validation_count: number of pairs to use; null for all.
        validation_crop: side of the central crop used of each validation frame; null for the whole frame.
        test: test pairs; no earlier stage sees them.
        test_count: number of pairs to use; null for all.
        test_crop: side of the central crop used of each test frame; null for the whole frame.
        bin: K bins validation and test frames K x K by colour site before noise is added, for clean references of real
            photographs, which then have about 1 / K^2 of their own noise.
    """

    pairs: str | None = "demo:train"
    count: Count | None = None
    select: str | list[str] = "first"
    crop: Side | None = None
    pictures: str | list[str] = "demo:"
    memory_mb: Annotated[int, Interval(ge=0, le=MOST)] = 0
    max_pixels: Annotated[int, Interval(ge=4, le=2**40)] | None = None
    validation: str | None = _USUAL
    validation_count: Count | None = None
    validation_crop: Side | None = 512
    test: str = "demo:test"
    test_count: Count | None = None
    test_crop: Side | None = 1024
    bin: Annotated[int, Interval(ge=1, le=16)] = 1

    def __post_init__(self) -> None:
        require_bounds(self, "data.")
        if self.validation == _USUAL:
            self.validation = "demo:validation"
            if self.pairs is not None and not self.pairs.startswith(_DEMO):
                self.validation = HELD_OUT

        if self.validation == HELD_OUT and self.pairs is None:
            raise ValueError("data.validation: auto holds out a part of data.pairs, which is null; set one of them")
        if not self.pictures:
            raise ValueError("data.pictures must name a folder, demo:, or a list of these, got an empty list")
        if self.pictures == OWN_PICTURES and self.pairs is None:
            raise ValueError("data.pictures: pairs takes those of data.pairs, which is null; set one of them")
        if _is_pair_folder(self.pairs) or _is_pair_folder(self.validation) or _is_pair_folder(self.test):
            return
        for setting in fields(PairSettings):
            if getattr(self, setting.name) is not None:
                text = f"applies to {_PAIRS}PATH, which neither pairs, validation nor test is"
                raise ValueError(f"data.{setting.name}: {text}")

    def pair_settings(self, spec: str | Sequence[Pair]) -> dict[str, Any]:
        """Give the settings of ``pairs:PATH`` for this spec; there are none for another kind of data."""
        if not _is_pair_folder(spec):
            return {}

        return {setting.name: getattr(self, setting.name) for setting in fields(PairSettings)}


def _is_pair_folder(spec: str | Sequence[Pair] | None) -> bool:
    """Tell whether frames are named as ``pairs:PATH``."""
    return isinstance(spec, str) and spec.startswith(_PAIRS)


@dataclass(frozen=True)
class ISPSource:
    """An ISP that is used as it is.

    Args:
        name: a shipped ISP by its name, or the file of one; or the YAML file of your own camera, see
            :class:`rawaug.Camera`.
        camera: maker and model of a published camera, or the YAML file of your own, in place of all cameras that the
            ISP knows, as ``universal`` does.
        iso: ISO of the noise of a measured camera; null for its measured range.
        draw: how the camera settings of pictures are drawn, unless an arm says otherwise.
    """

    name: str = "universal"
    camera: str | None = None
    iso: float | None = None
    draw: Draw = Draw()

    def load(self) -> DictionaryISP:
        """Load the ISP; its ``info["key"]`` is a hash of its file and its camera.

        Raises:
            FileNotFoundError: if there is no such ISP, or no such file of a camera.
            ValueError: if the file is damaged, the camera is unknown, or the ISP was fitted to frames of another.
        """
        isp = DictionaryISP.from_pretrained(self.name)
        key = sha256(find_weights(self.name))
        if self.camera is not None:
            isp = isp.with_cameras(self.camera)
            key = fingerprint(key, isp.info)

        isp.info["key"] = key
        return isp


def _by_name(isp: Any) -> Any:
    """Take the name of an ISP for one whose settings are the usual ones."""
    if isinstance(isp, str):
        return ISPSource(isp)
    return isp


@dataclass
class ArmConfig:
    """One way of training; everything else is the same for all arms.

    Args:
        augmented: share of every batch that comes from ``source``, 0 to 1; the rest are crops of the real pairs.
        source: pictures are made RAW through the ISP; own does so with the pictures of the pairs themselves, cropped
            and turned so that RAW stays at the sites where it was read; noise are the clean RAW frames of the pairs
            with noise drawn anew; more are the true pairs of ``data.pairs`` beyond the chosen ones as well, a ceiling
            of what any augmentation can gain.
        batch: crops in a step, in place of ``train.batch``; null takes that one. Arms that are compared should see as
            many real crops: 2 alone against 2 of 8.
        draw: how the camera settings of pictures are drawn; null takes ``isp.draw``.
        srgb: for sRGB targets, how pictures are developed; null draws every demosaicing, without JPEG.
        zoom: for supervised arms, half of the crops of pictures are enlarged by up to this factor, see
            :class:`rawaug.RawPairs`; 1 for none.
        srgb_noise: for sRGB targets, noise drawn on the pictures themselves, in place of the camera's: Gaussian,
            BSRGAN, Coloured, or {name, settings}, see :mod:`rawaug.training.srgb_noise`.
        srgb_share: share of the samples that have ``srgb_noise``; the rest have the camera's.
        noise_level: for sRGB targets, the level of noise that is given to a network that reads one; null for none.
        estimator: training target, a name or {name, settings}: supervised uses clean frames; distilled uses
            what another denoiser makes of the noisy ones; noisier, noise2noise, r2r and neighbor2neighbor use noisy
            frames only, see :mod:`rawaug.training.estimators`.
        denoiser: this arm's network, in place of the recipe's; ``{start: rawaug-small}`` fine-tunes a shipped one.
        learning_rate: learning rate in place of ``train.learning_rate``; null takes that one.
        weigh: weighting in place of ``train.weigh``; null takes that one.
        steps: largest number of steps, if fewer than ``train.steps`` are enough, as for fine-tuning; null takes them
            all.
    """

    augmented: Share = 0.0
    source: Literal["pictures", "own", "noise", "more"] = "pictures"
    batch: Count | None = None
    draw: Draw | None = None
    srgb: Srgb | None = None
    zoom: Annotated[float, Interval(ge=1.0, le=float(MOST))] = 1.0
    srgb_noise: str | dict[str, Any] | None = None
    srgb_share: Share = 1.0
    noise_level: Conditioning | None = None
    estimator: str | dict[str, Any] = "supervised"
    denoiser: DenoiserConfig | None = None
    learning_rate: Rate | None = None
    weigh: Weighing | None = None
    steps: Count | None = None

    def __post_init__(self) -> None:
        require_bounds(self)
        try:
            ESTIMATORS.make(self.estimator)
        except ValueError as error:
            raise ValueError(f"estimator: {error}") from None

    @property
    def sees_clean(self) -> bool:
        """Whether the estimator needs clean frames."""
        name, _ = split_spec(self.estimator)
        return bool(ESTIMATORS[name].sees_clean)


@dataclass
class Recipe:
    """A whole experiment on RAW. Other tasks have more keys, see :mod:`rawaug.experiment`.

    Args:
        name: of the output folder within ``out``.
        data: where pictures come from.
        isp: an ISP to use as it is, by a shipped one's name or a file, or {name, camera, iso, draw}; null fits one to
            ``data.pairs``.
        fit: how the dictionary ISP is fitted, if ``isp`` is null.
        noise: noise added to clean RAW in training, and to test frames without a noisy capture: the name of a preset or
            of a camera, a list of names from which each picture draws one, [shot_var, read_var], {name, settings} of a
            camera or a model, or "camera", the levels measured on the frames that the ISP is fitted to.
        denoiser: the network.
        train: the training loop.
        arms: the variants to compare, by name; all supervised, or all self-supervised (no stage sees a clean frame).
        classical: classical denoisers to compare with, such as Wavelet, or {name: Wavelet, settings: {strength: 0.8}}.
            BM3D is left out if its wheel is not installed, and a line says so.
        views: number of views of the self-ensemble: 4, the flips, as in the paper, or 8, with quarter turns.
        baselines: trained denoisers to compare with as they are: names of shipped ones, or files.
        self_ensemble: whether every arm is also scored averaged over ``views``, at that many times the cost.
        seed: of the first run.
        steps: optimiser steps, in place of ``train.steps``.
        seeds: number of runs, with seeds ``seed``, ``seed + 1``, ...; several give mean and spread.
        device: auto, cpu, cuda, ...: Fabric's accelerator.
        devices: number of devices.
        out: folder of all runs.
    """

    kind: ClassVar[str] = "raw"
    """The name of the task that reads these settings."""

    target: ClassVar[Target] = "raw"
    """The target of the augmentation."""

    from_pictures: ClassVar[bool] = False
    """Whether arms can train on nothing but pictures, with clean targets."""

    full_colour: ClassVar[bool] = False
    """Whether frames are binned so that the four sites of a cell make a pixel of full colour."""

    scoring: ClassVar[tuple[str, ...]] = ()
    """Further keys on which scores depend, but no weights."""

    name: str = "experiment"
    data: DataConfig = field(default_factory=DataConfig)
    isp: Annotated[ISPSource | None, BeforeValidator(_by_name)] = None
    fit: FitConfig = field(default_factory=FitConfig)
    noise: NoiseSetting = "cycleisp_sidd"
    denoiser: DenoiserConfig = field(default_factory=DenoiserConfig)
    train: TrainConfig = field(default_factory=TrainConfig)
    arms: dict[str, ArmConfig] = field(default_factory=dict)
    classical: list[str | dict[str, Any]] = field(default_factory=list)
    views: Literal[4, 8] = 8
    baselines: list[str] = field(default_factory=list)
    self_ensemble: bool = True
    steps: Count | None = None
    seed: Annotated[int, Interval(ge=-(2**63), le=2**62)] = 0
    seeds: Annotated[int, Interval(ge=1, le=1000)] = 1
    device: str = "auto"
    devices: Count = 1
    out: str = "runs"

    def __post_init__(self) -> None:
        if not self.arms:
            raise ValueError("arms: a recipe needs at least one arm")
        require_bounds(self)
        self.isp = _by_name(self.isp)

        if self.steps is not None:
            self.train = replace(self.train, steps=self.steps)

        if self.isp is not None and self.isp.iso is not None and not isinstance(self.noise, str):
            raise ValueError("isp.iso: applies to the noise of one camera by name; set noise to its name, or to camera")

        self._require_data()
        for label, arm in self.arms.items():
            require_folder_name(label, "arms")
            try:
                self._require_arm(label, arm)
            except ValueError as error:
                raise ValueError(f"arms.{label}: {error}") from None

    def _require_data(self) -> None:
        """Raise ValueError unless the arms as a whole have the frames that they need."""
        only_pictures = all(arm.augmented == 1.0 for arm in self.arms.values())
        see_clean = {arm.sees_clean for arm in self.arms.values()}

        if self.data.pairs is None and self.isp is None:
            raise ValueError("data.pairs: fitting an ISP needs pairs; set it, or isp: universal")
        if self.data.pairs is None and not only_pictures:
            raise ValueError("data.pairs: without real pairs every arm must have augmented: 1")
        if len(see_clean) > 1:
            raise ValueError(
                "arms: supervised and self-supervised arms cannot be mixed; the latter must not see clean frames"
            )
        if self.from_pictures and not (only_pictures and see_clean == {True}):
            raise ValueError(f"arms: {self.target} targets are made from pictures; set augmented: 1 and no estimator")

    def _require_arm(self, label: str, arm: ArmConfig) -> None:
        """Raise ValueError if an arm has keys of another target, or a weighting that its estimator cannot have."""
        if arm.srgb_noise is not None:
            noise_on_srgb(arm.srgb_noise)

        for key in ("srgb", "srgb_noise", "noise_level"):
            if getattr(arm, key) is not None and self.target != "srgb":
                raise ValueError(f"{key} applies to target 'srgb', not {self.target!r}; leave it out")

        if arm.source != "pictures":
            if self.data.pairs is None:
                raise ValueError(f"source: {arm.source} needs real pairs; set data.pairs")
            if not arm.sees_clean or self.target != "raw" or self.from_pictures:
                raise ValueError(f"source: {arm.source} is for supervised arms on RAW; leave it out")

        name, _ = split_spec(arm.estimator)
        weigh = self.loop(label).weigh
        weighings = ESTIMATORS[name].weighings
        if weigh not in weighings:
            raise ValueError(f"weigh: {weigh} is not for noisy targets of {name}; use {' or '.join(weighings)}")

    @property
    def draw(self) -> Draw:
        """How camera settings are drawn where an arm does not say so."""
        if self.isp is None:
            return Draw()

        return self.isp.draw

    @property
    def noise_at_iso(self) -> Any:
        """The noise, at the ISO of ``isp.iso`` if that is set."""
        if self.isp is None or self.isp.iso is None:
            return self.noise

        return {"name": self.noise, "settings": {"iso": self.isp.iso}}

    @property
    def noise_in_test(self) -> Any:
        """The noise of test frames without a capture; None if their tables say it."""
        return self.noise_at_iso

    @property
    def all_seeds(self) -> range:
        """The seeds of the runs."""
        return range(self.seed, self.seed + self.seeds)

    def weights_settings(self, arm: str) -> dict[str, Any]:
        """Collect the keys that the weights of an arm depend on, for it and for no other."""
        settings = asdict(self)
        for key in (*_NOT_OF_WEIGHTS, *self.scoring):
            del settings[key]

        data = settings["data"]
        irrelevant = {"memory_mb", "test", "test_count", "test_crop"}
        if self.data.validation is None:
            irrelevant |= {"validation_count", "validation_crop", "bin"}

        settings["data"] = {key: data[key] for key in data.keys() - irrelevant}
        settings["train"] = self.loop(arm).weights_settings(validated=self.data.validation is not None)
        settings["denoiser"] = asdict(self.network(arm))
        settings["arm"] = asdict(self.arms[arm])
        return settings | {"draw": asdict(self.draw), "noise": self.noise_at_iso}

    def scores_settings(self) -> dict[str, Any]:
        """Collect the keys that scores depend on besides the weights."""
        settings = {key: getattr(self, key) for key in ("views", *self.scoring)}
        for key in ("test", "test_count", "test_crop", "bin"):
            settings[key] = getattr(self.data, key)

        return settings

    def network(self, arm: str) -> DenoiserConfig:
        """Return the network of an arm: its own, or else the recipe's."""
        return self.arms[arm].denoiser or self.denoiser

    def loop(self, arm: str) -> TrainConfig:
        """Return the training loop of an arm: the recipe's, with the arm's own rate, weighting, batch and steps."""
        settings = self.arms[arm]
        loop = self.train
        if settings.learning_rate is not None:
            loop = replace(loop, learning_rate=settings.learning_rate)
        if settings.weigh is not None:
            loop = replace(loop, weigh=settings.weigh)
        if settings.batch is not None:
            loop = replace(loop, batch=settings.batch)
        if settings.steps is not None:
            loop = replace(loop, steps=min(settings.steps, loop.steps))

        return loop

    def shortest(self) -> Recipe:
        """Shorten the recipe to one step for each arm, on the middles of a few frames; networks and precision stay."""
        data = replace(self.data, count=2, select="first", validation_count=1, test_count=1)
        data = replace(data, validation_crop=_SHORT_CROP, test_crop=_SHORT_CROP)
        train = replace(self.train, steps=1, validate_every=1, checkpoint_every=1, workers=min(self.train.workers, 1))
        if find_device(self.device).type == "cpu":
            train = replace(train, batch=min(train.batch, 4 * self.devices))
        return replace(self, data=data, fit=self.fit.shortest(), train=train, steps=None, seeds=1, views=4)

    @property
    def self_supervised(self) -> bool:
        """Whether the arms may see only noisy frames."""
        return not any(arm.sees_clean for arm in self.arms.values())
