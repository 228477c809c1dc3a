"""What a network is made of: one frozen dataclass per kind, stored as JSON beside its weights."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, ClassVar, TypeVar

from navrep_data.errors import ConfigError, check_whole, did_you_mean
from navrep_data.schema import N_RAYS, RINGS_SHAPE

LIDARS = ("rings", "1d")
CONTEXT_RULES = ("oldest-32", "newest-32", "carried-state")
ACTION_ALIGNMENTS = ("leading", "taken")
SQUASHES = ("clip", "tanh")
# A config from outside must not make us allocate without bound: the largest network that passes has about 0.5 GB.
_LARGEST = 16384
_LARGEST_OF = {"z_size": 512, "h_size": 4096, "n_layers": 8, "n_blocks": 32, "n_mixture": 16, "n_hidden": 1024}

OBSERVATION_SHAPES: dict[str, tuple[int, ...]] = {"rings": RINGS_SHAPE, "1d": (N_RAYS,)}
"""Shape of one observation as the networks take it, by representation."""

ConfigT = TypeVar("ConfigT", bound="ModelConfig")


@dataclass(frozen=True)
class ModelConfig:
    """Base of all configs; checks the fields that several of them share."""

    kind: ClassVar[str] = ""

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            limit = _LARGEST_OF.get(field.name, _LARGEST)
            if field.type == "int":
                object.__setattr__(self, field.name, check_whole(f"{field.name} of a {self.kind}", value, 1, limit))
            if field.type == "bool" and type(value) is not bool:
                raise ConfigError(f"{field.name} of a {self.kind} is {str(value)!r}, expected true or false.")
        for name, allowed in (("lidar", LIDARS), ("action_alignment", ACTION_ALIGNMENTS)):
            value = getattr(self, name, allowed[0])
            if value not in allowed:
                raise ConfigError(f"{name} of a {self.kind} is {str(value)!r}, expected one of: {', '.join(allowed)}.")

    def to_dict(self) -> dict[str, Any]:
        """Return the fields as plain JSON values."""
        return dataclasses.asdict(self)

    @classmethod
    def from_dict(cls: type[ConfigT], values: Any) -> ConfigT:
        """Make a config from JSON values.

        Raises
        ------
        ConfigError
            If `values` is no object, has a field that this kind lacks, or a value that cannot be used.
        """
        if not isinstance(values, dict):
            raise ConfigError(f"The config of a {cls.kind} is a {type(values).__name__}, expected a JSON object.")
        known = [field.name for field in dataclasses.fields(cls)]
        for name in values:
            if name not in known:
                raise ConfigError(
                    f"A {cls.kind} has no setting {str(name)!r}.{did_you_mean(str(name), known)} "
                    f"Known: {', '.join(known)}."
                )
        return cls(**values)


@dataclass(frozen=True)
class VAEConfig(ModelConfig):
    """V: a convolutional variational auto-encoder.

    Attributes
    ----------
    lidar : str
        ``"rings"`` or ``"1d"``.
    z_size : int
        Numbers per code: 32 in the modular and joint models, 64 in the transformers.
    """

    kind: ClassVar[str] = "vae"
    lidar: str = "1d"
    z_size: int = 32


@dataclass(frozen=True)
class MemoryConfig(ModelConfig):
    """M: an LSTM that predicts a mixture of normal distributions over the change of z and goal.

    Attributes
    ----------
    z_size, h_size, n_mixture : int
        Numbers per code, LSTM cells, components per predicted number.
    action_alignment : str
        Which action a row is fed: ``"leading"`` (led to the row) or ``"taken"`` (chosen at it).
    """

    kind: ClassVar[str] = "memory"
    z_size: int = 32
    h_size: int = 512
    n_mixture: int = 5
    action_alignment: str = "leading"


@dataclass(frozen=True)
class ModularConfig(ModelConfig):
    """V and M, trained one after the other.

    Attributes
    ----------
    lidar, z_size
        As for :class:`VAEConfig`.
    h_size, n_mixture, action_alignment
        As for :class:`MemoryConfig`.
    """

    kind: ClassVar[str] = "modular"
    lidar: str = "1d"
    z_size: int = 32
    h_size: int = 512
    n_mixture: int = 5
    action_alignment: str = "leading"


@dataclass(frozen=True)
class JointConfig(ModelConfig):
    """V and a two-layer LSTM, trained together.

    Attributes
    ----------
    lidar, z_size
        As for :class:`VAEConfig`.
    h_size : int
        LSTM cells per layer; twice `z_size`, since half of them predict z and half the goal.
    n_layers : int
        LSTM layers.
    action_alignment : str
        As for :class:`MemoryConfig`.
    residual : bool
        Predict the change of z and goal instead of their next values; the released models do not.
    """

    kind: ClassVar[str] = "joint"
    lidar: str = "1d"
    z_size: int = 32
    h_size: int = 64
    n_layers: int = 2
    action_alignment: str = "leading"
    residual: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.h_size != 2 * self.z_size:
            raise ConfigError(f"h_size is {self.h_size}, expected 2 * z_size = {2 * self.z_size} in a joint model.")


@dataclass(frozen=True)
class TransformerConfig(ModelConfig):
    """V and a causal transformer, trained together.

    Attributes
    ----------
    lidar, z_size
        As for :class:`VAEConfig`; h has the size of z.
    n_blocks, n_heads : int
        Blocks, and attention heads per block.
    context : int
        Longest sequence (learned positions).
    action_alignment : str
        As for :class:`MemoryConfig`.
    residual : bool
        As for :class:`JointConfig`.
    """

    kind: ClassVar[str] = "transformer"
    lidar: str = "1d"
    z_size: int = 64
    n_blocks: int = 8
    n_heads: int = 8
    context: int = 32
    action_alignment: str = "leading"
    residual: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.z_size % self.n_heads:
            raise ConfigError(f"z_size is {self.z_size}, expected a multiple of n_heads = {self.n_heads}.")

    @property
    def h_size(self) -> int:
        """Numbers of h: as many as z has."""
        return self.z_size


@dataclass(frozen=True)
class ControllerConfig(ModelConfig):
    """C: two separate perceptrons of two tanh layers, for the action and for the value.

    Attributes
    ----------
    n_inputs, n_hidden : int
        Features, and units per layer.
    squash : str
        How the network's output becomes an action: ``"clip"`` to [-1, 1], as the released ones; ``"tanh"``.
    max_speed : float
        Longest velocity vector that is commanded [m/s]; 0 = no limit beyond [-1, 1] on each axis.
    """

    kind: ClassVar[str] = "controller"
    n_inputs: int = 69
    n_hidden: int = 64
    squash: str = "clip"
    max_speed: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_bounds(self.kind, self.squash, self.max_speed)


@dataclass(frozen=True)
class EndToEndConfig(ModelConfig):
    """The end-to-end network: V's convolutions, then two perceptrons of two ReLU layers.

    Attributes
    ----------
    lidar : str
        ``"rings"`` or ``"1d"``.
    n_features, n_hidden : int
        Numbers that the convolutions give, and units per layer.
    squash, max_speed
        As for :class:`ControllerConfig`.
    """

    kind: ClassVar[str] = "e2e"
    lidar: str = "1d"
    n_features: int = 32
    n_hidden: int = 64
    squash: str = "clip"
    max_speed: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_bounds(self.kind, self.squash, self.max_speed)


def _check_bounds(kind: str, squash: str, max_speed: float) -> None:
    if squash not in SQUASHES:
        raise ConfigError(f"squash of a {kind} is {str(squash)!r}, expected one of: {', '.join(SQUASHES)}.")
    if isinstance(max_speed, bool) or not isinstance(max_speed, int | float) or not 0.0 <= max_speed <= 10.0:
        raise ConfigError(f"max_speed of a {kind} is {max_speed!r}, expected 0 (no limit) to 10 m/s.")
