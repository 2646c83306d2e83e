"""The few loops where the time goes: each a plain-torch definition with compiled versions that agree with it."""

from .add_seen import add_seen
from .backend import BACKENDS, get_backend, set_backend, use_backend
from .footprints import Footprints, footprints
from .grid_encode import GridLevels, grid_encode
from .grid_network import grid_network
from .march import MarchedSamples, MarchGrid, march
from .march_to_size import march_to_size
from .packed_sum import packed_sum
from .packed_weights import packed_weights
from .relu_layers import has_bfloat16, is_bfloat16_wanted, relu_layers
from .seen_parts import SeenParts, seen_parts
from .series_sums import series_sums
from .shade import shade
from .skip_distances import skip_distances
from .trace_network import FrameTables, is_traced, trace_network

__all__ = [
    "BACKENDS", "Footprints", "FrameTables", "GridLevels", "MarchGrid", "MarchedSamples", "SeenParts", "add_seen",
    "footprints", "get_backend", "grid_encode", "grid_network", "has_bfloat16", "is_bfloat16_wanted", "is_traced",
    "march", "march_to_size", "packed_sum", "packed_weights", "relu_layers", "seen_parts", "series_sums",
    "set_backend", "shade", "skip_distances", "trace_network", "use_backend",
]  # fmt: skip
