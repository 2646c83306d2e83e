"""A canonical field seen through a deformation: every dynamic model of the package."""

from dataclasses import replace

import torch
from torch import Tensor

from dnerf.checks import check_positive
from dnerf.compositing import FieldOutput
from dnerf.deformations import (
    CarriedBodies,
    CarriedDeformation,
    Deformation,
    FlowDeformation,
    FrameLattice,
    FrozenDeformation,
    IdentityDeformation,
    deform_along_rays,
)
from dnerf.fields.baked import Baking
from dnerf.fields.base import RadianceField
from dnerf.rays import Rays


class DeformedField(RadianceField):
    """The canonical field at deformed positions: (density, rgb)(x, d, t) = canonical(deformation(x, t), d, t).

    Viewing directions are not turned by the deformation (as in D-NeRF). Its output carries the extras
    "canonical_positions" (..., 3), "positions" (..., 3) and "times" (...,) as they came, and "carried_positions"
    (..., 3), behind `bodies`, at which the deformation was asked.

    Args:
        deformation: world -> canonical.
        canonical: field in canonical space; it may use the time as well.
        frame_lattice: where frames see the deformation through a lattice; None for frames that ask it at every sample.
        baking: how the contents of a finished canonical field are kept for the frames of a sequence, if it has any;
            None for frames that ask it at every sample.
        spacing: along a ray, in world units, at which the deformation is asked in training, with displacements
            interpolated in between, see `deform_along_rays`; None to ask it at every sample.
        motion_flow: place for a flow that says how matter moves where the deformation does not, for fields that show
            matter elsewhere without their deformation knowing; pictures do not ask it, see `motion`. None for none.
        bodies: what positions meet first: places for small fast bodies, see `dnerf.body_search`. None for none.

    Raises:
        ValueError: if the spacing is not positive.
    """

    def __init__(
        self,
        deformation: Deformation,
        canonical: RadianceField,
        *,
        spacing: float | None = None,
        frame_lattice: FrameLattice | None = None,
        baking: Baking | None = None,
        motion_flow: FlowDeformation | None = None,
        bodies: CarriedBodies | None = None,
    ) -> None:
        super().__init__()
        if spacing is not None:
            check_positive("spacing", spacing)
        self.spacing = spacing
        self.deformation = deformation
        self.canonical = canonical
        self.frame_lattice = frame_lattice
        self.baking = baking
        self.motion_flow = motion_flow
        self.bodies = bodies
        self.register_buffer("found_motion", None if motion_flow is None else torch.tensor(False))
        self.found_motion: Tensor | None

    @property
    def has_found_motion(self) -> bool:
        """Whether `motion_flow` has been fitted (`dnerf.motion_search`)."""
        return self.found_motion is not None and bool(self.found_motion)

    def set_found_motion(self, found: bool) -> None:
        """Say whether it has been; without a `motion_flow` it has not, and nothing changes."""
        if self.found_motion is not None:
            self.found_motion.fill_(found)

    @property
    def motion(self) -> Deformation:
        """How matter moves, as a map from the world to one place per piece of matter.

        It is the deformation, or the flow that has been fitted instead, behind the bodies that are carried.
        """
        if self.motion_flow is not None and self.has_found_motion:
            return self._behind_bodies(self.motion_flow)
        return self.modelled_motion

    @property
    def modelled_motion(self) -> Deformation:
        """The deformation, behind the bodies that are carried, if there are any."""
        return self._behind_bodies(self.deformation)

    def _behind_bodies(self, deformation: Deformation) -> Deformation:
        if self.bodies is None or not self.bodies.num_bodies:
            return deformation
        return CarriedDeformation(self.bodies, deformation)

    def carried(self, positions: Tensor, times: Tensor) -> Tensor:
        """Positions (..., 3) at times (...,) as the deformation sees them: small fast bodies are at home."""
        if self.bodies is None or not self.bodies.num_bodies:
            return positions
        return self.bodies(positions, times)

    def density(self, positions: Tensor, times: Tensor) -> Tensor:
        """Density (...,) at positions (..., 3) and times (...,)."""
        carried = self.carried(positions, times)
        return self._shown(self.canonical.density(self._deformed(carried, times), times), carried)

    def forward(self, positions: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
        """Density (...,) and rgb (..., 3) at positions (..., 3), directions (..., 3) and times (...,)."""
        carried = self.carried(positions, times)
        canonical_positions = self._deformed(carried, times)
        output = self.canonical(canonical_positions, directions, times)
        extras = {
            "canonical_positions": canonical_positions,
            "carried_positions": carried,
            "positions": positions,
            "times": times,
        }
        density = self._shown(output.density, carried)
        return replace(output, density=density, extras={**output.extras, **extras})

    def along(self, rays: Rays, ray_indices: Tensor, distances: Tensor) -> FieldOutput:
        """What `forward` says at distances (N,) along the rays with numbers (N,), without extras where it can do so."""
        deformation = self.deformation
        if not isinstance(deformation, FrozenDeformation) or (self.bodies is not None and self.bodies.num_bodies):
            return super().along(rays, ray_indices, distances)
        positions = deformation.along(rays, ray_indices, distances)
        times = distances.new_tensor(deformation.time).expand(distances.shape)
        return self.canonical(positions, rays.directions.index_select(0, ray_indices), times)

    def _shown(self, density: Tensor, carried: Tensor) -> Tensor:
        """Densities (...,) at carried positions (..., 3): none at the home of a body that is not there."""
        if self.bodies is None or not self.bodies.num_bodies:
            return density
        return torch.where(self.bodies.is_nowhere(carried), 0, density)

    def _deformed(self, positions: Tensor, times: Tensor) -> Tensor:
        if self.spacing is None or not self.training or isinstance(self.deformation, IdentityDeformation):
            return self.deformation(positions, times)
        return deform_along_rays(self.deformation, positions, times, self.spacing)

    def finished(self) -> RadianceField:
        """The same with the canonical field baked, if that is wanted and can be done."""
        if self.baking is None or not self.canonical.num_contents:
            return self
        baked = self.baking.bake(self.canonical)
        field = DeformedField(
            self.deformation, baked, frame_lattice=self.frame_lattice, motion_flow=self.motion_flow, bodies=self.bodies
        )
        field.set_found_motion(self.has_found_motion)
        return self._like(field)

    def at_time(self, time: float, extent: Tensor | None = None) -> RadianceField:
        """The same with both parts at that time; the deformation on the lattice, if there is one and anything moves."""
        deformation, canonical = self.deformation, self.canonical.at_time(time, None)
        if self.frame_lattice is not None and not isinstance(deformation, IdentityDeformation):
            deformation = self.frame_lattice.at_time(deformation, time, extent)
        if deformation is self.deformation and canonical is self.canonical:
            return self
        return self._like(DeformedField(deformation, canonical, bodies=self.bodies))

    def _like(self, field: "DeformedField") -> "DeformedField":
        """Another field in this one's mode; its parts, which may be shared, keep theirs."""
        field.training = self.training
        return field
