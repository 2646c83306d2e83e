"""Rays of one frame through what is kept of a field, instead of asking it sample by sample."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from dnerf.deformations.carried_bodies import CarriedBodies
from dnerf.deformations.frame_lattice import FrozenDeformation
from dnerf.deformations.identity import IdentityDeformation
from dnerf.fields import DeformedField, RadianceField
from dnerf.fields.baked import BakedField
from dnerf.fields.grid import GridFieldAtTime
from dnerf.kernels import FrameTables, MarchGrid, NetworkTables, few_nonzero, trace, trace_network
from dnerf.kernels.backend import choose
from dnerf.kernels.grid_network import is_fused
from dnerf.kernels.trace import DONE, ELSEWHERE, NUM_STATES
from dnerf.rays import Rays

Tracer = Callable[[Rays], tuple[Tensor, Tensor]]
"""What rays of one time show without a background, (R, 5), and of which rays (R,) that is true."""

PIONEERS = 5  # one ray of so many is sent ahead once, to find what most of its neighbours will want


class FrameTracer:
    """Pictures of one time of a field whose displacements are on a lattice and whose contents are in bricks.

    What `Renderer` shows of it, with one kernel (`trace`) instead of a chain of them; the two differ by rounding, and
    by the light of the intervals that only one of them takes for unseen. Where the kernel wants vertices or bricks
    that do not exist yet, they are made.

    What a field adds to its contents (`RadianceField.changes`) is kept on the deformation's lattice. Rays that meet
    carried bodies are not followed: behind these, places are not where the lattice has them.

    Args:
        deformation: on its lattice, which it fills.
        canonical: in its bricks, which it makes.
        grid: occupied cells at that time.
        waves: (K,), see `RadianceField.series_at`.
        log_shift: likewise.
        stop_transmittance: a ray ends once so little light is left, and if intervals are split, one that is seen as
            little is left out.
        bodies: that are carried, or None.
    """

    def __init__(
        self,
        deformation: FrozenDeformation,
        canonical: BakedField,
        grid: MarchGrid,
        *,
        waves: Tensor,
        log_shift: float,
        stop_transmittance: float,
        bodies: CarriedBodies | None = None,
    ) -> None:
        if canonical.has_changes:
            deformation.also_keep(canonical.changes)
        self.deformation = deformation
        self.canonical = canonical
        self.grid = grid
        self.waves = waves
        self.log_shift = log_shift
        self.stop_transmittance = stop_transmittance
        self.bodies = bodies

    @classmethod
    def of(
        cls, field: RadianceField, grid: MarchGrid | None, time: float, stop_transmittance: float
    ) -> "FrameTracer | None":
        """A tracer of a frame's field, see `RadianceField.at_time`; None where there is no lattice, brick or kernel.

        Args:
            field: at that time.
            grid: occupied cells at that time, or None.
            time: of the frame, in [0, 1].
            stop_transmittance: see `FrameTracer`.
        """
        if grid is None or not isinstance(field, DeformedField):
            return None
        deformation, canonical = field.deformation, field.canonical
        if not isinstance(deformation, FrozenDeformation) or not isinstance(canonical, BakedField):
            return None
        series = canonical.series_at(time)
        if series is None or grid.aabb.dtype != torch.float32 or choose(grid.aabb) != "numba":
            return None
        return cls(
            deformation, canonical, grid, waves=series[0], log_shift=series[1], stop_transmittance=stop_transmittance,
            bodies=field.bodies,
        )  # fmt: skip

    @torch.no_grad()
    def __call__(self, rays: Rays) -> tuple[Tensor, Tensor]:
        """What R rays show, without a background.

        Args:
            rays: all of the frame's time.

        Returns:
            rgb, depth times opacity, and opacity, (R, 5); and of which rays (R,) that is true. The others left the
            lattices, meet carried bodies, or wanted bricks for which there is no room; theirs is 0.
        """
        for part in (self.deformation, self.canonical):
            part.move_to(rays.origins.device)
        states = torch.zeros(len(rays), NUM_STATES, device=rays.origins.device)
        states[:, 0] = 1
        numbers = torch.zeros(len(rays), dtype=torch.int64, device=states.device)
        if self.bodies is not None and self.bodies.num_bodies:
            numbers[self.bodies.are_met(rays.origins, rays.directions, self.deformation.time)] = ELSEWHERE
        self._fill_ahead(rays, states, numbers)
        while self.deformation.fill(self._follow(rays, states, numbers)):
            pass
        is_done = numbers == DONE
        sums = torch.cat([states[:, 1:], 1 - states[:, :1]], dim=-1)
        return torch.where(is_done[:, None], sums, 0).to(rays.origins.dtype), is_done

    def _fill_ahead(self, rays: Rays, states: Tensor, numbers: Tensor) -> None:
        """Fill most of what fresh rays will want at once, since every round of asking has its price.

        That is what lies around occupied cells. Where matter is not few cells but haze, rays see little of it: some of
        them are followed ahead as far as they come, and what they want is filled.
        """
        if self.deformation.fill_around(self.grid, len(rays)):
            return
        fresh = numbers == 0
        is_ahead = fresh & (torch.arange(len(rays), device=states.device) % PIONEERS == 0)
        numbers[fresh & ~is_ahead] = DONE
        self.deformation.fill(self._follow(rays, states, numbers))
        numbers[fresh & ~is_ahead] = 0

    def _follow(self, rays: Rays, states: Tensor, numbers: Tensor) -> Tensor:
        """Take the states and numbers of rays as far as the vertices that are known let them come.

        Which vertices are asked for together depends on the frame alone, not on the bricks that frames before it left.

        Returns:
            The vertices that are wanted, flat places (K,) among the deformation's.
        """
        while True:
            ahead, reached, vertices, bricks = trace(
                rays.origins, rays.directions, rays.near, rays.far, states, numbers, self._tables(),
                step=self.grid.step, splits=self.grid.splits, split_weight=self.grid.split_weight,
                min_weight=self.stop_transmittance, stop_transmittance=self.stop_transmittance,
                cells_per_unit=self.canonical.cells_per_unit, log_shift=self.log_shift,
            )  # fmt: skip
            states.copy_(ahead)
            numbers.copy_(reached)
            if not self.canonical.make(bricks.nonzero()):
                return few_nonzero(vertices)

    def _tables(self) -> FrameTables:
        return FrameTables(
            occupancy=self.grid.occupancy,
            skips=self.grid.skips,
            aabb=self.grid.aabb,
            displacements=self.deformation.displacements,
            is_known=self.deformation.is_known,
            low=self.deformation.low,
            sides=self.deformation.sides,
            slots=self.canonical.slots,
            bricks=self.canonical.bricks,
            brick_low=self.canonical.low,
            waves=self.waves,
        )


class NetworkTracer:
    """Pictures of one time of a grid field whose displacements are on a lattice, of a frame alone.

    What `Renderer` shows of it, with one kernel (`trace_network`) instead of rounds of several; the two differ by
    rounding, and by the light of the intervals that only one of them takes for unseen.

    Args:
        deformation: on its lattice, which is filled around all occupied cells (`FrozenDeformation.fill_around`).
        tables: see `GridFieldAtTime.tables`.
        grid: occupied cells at that time.
        stop_transmittance: see `FrameTracer`.
        bodies: likewise.
    """

    def __init__(
        self,
        deformation: FrozenDeformation,
        tables: dict[str, Any],
        grid: MarchGrid,
        *,
        stop_transmittance: float,
        bodies: CarriedBodies | None = None,
    ) -> None:
        self.deformation = deformation
        self.grid = grid
        self.stop_transmittance = stop_transmittance
        self.bodies = bodies
        self.tables = NetworkTables(
            occupancy=grid.occupancy,
            skips=grid.skips,
            aabb=grid.aabb,
            displacements=deformation.displacements,
            is_known=deformation.is_known,
            low=deformation.low,
            sides=deformation.sides,
            **tables,
        )

    @classmethod
    def of(cls, field: RadianceField, grid: MarchGrid, stop_transmittance: float) -> "NetworkTracer | None":
        """A tracer of a frame's field, see `RadianceField.at_time`, under autocast to the precision in which it is
        asked; None where there is no lattice, or no kernel for its network.

        Args:
            field: at that time; its lattice is filled.
            grid: occupied cells at that time.
            stop_transmittance: see `FrameTracer`.
        """
        if not isinstance(field, DeformedField) or not isinstance(field.deformation, FrozenDeformation):
            return None
        tables = _tables(field.canonical)
        if tables is None or grid.aabb.dtype != torch.float32:
            return None
        return cls(field.deformation, tables, grid, stop_transmittance=stop_transmittance, bodies=field.bodies)

    @staticmethod
    def serves(field: RadianceField) -> bool:
        """Whether there is one for frames of a field, under autocast as for `of`, wherever its matter is no haze."""
        if not isinstance(field, DeformedField) or field.frame_lattice is None:
            return False
        return (
            not isinstance(field.deformation, IdentityDeformation) and _tables(field.canonical.at_time(0)) is not None
        )

    @torch.no_grad()
    def __call__(self, rays: Rays) -> tuple[Tensor, Tensor]:
        """What R rays show, without a background.

        Args:
            rays: all of the frame's time.

        Returns:
            rgb, depth times opacity, and opacity, (R, 5); and of which rays (R,) that is true. The others left the
            lattice, came to vertices that are not known, or meet carried bodies; theirs is 0.
        """
        is_left = torch.zeros(len(rays), dtype=torch.bool, device=rays.origins.device)
        if self.bodies is not None and self.bodies.num_bodies:
            is_left = self.bodies.are_met(rays.origins, rays.directions, self.deformation.time)
        states, is_done = trace_network(
            rays.origins, rays.directions, rays.near, rays.far, is_left, self.tables,
            step=self.grid.step, splits=self.grid.splits, split_weight=self.grid.split_weight,
            min_weight=self.stop_transmittance, stop_transmittance=self.stop_transmittance,
        )  # fmt: skip
        sums = torch.cat([states[:, 1:], 1 - states[:, :1]], dim=-1)
        return torch.where(is_done[:, None], sums, 0).to(rays.origins.dtype), is_done


def _tables(canonical: RadianceField) -> dict[str, Any] | None:
    """What `NetworkTables` have to know of a canonical field at one time; None if no kernel asks it."""
    tables = canonical.tables() if isinstance(canonical, GridFieldAtTime) else None
    if tables is None or any(tables[name].dtype != torch.float32 for name in ("table", "field_low", "shifts")):
        return None
    return tables if is_fused(tables["table"], tables["weights"][0].shape[1], tables["weights"]) else None
