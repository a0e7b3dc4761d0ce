"""Ray scene: bring the trees that rays are traced against up to date, once for all passes that trace."""

from __future__ import annotations

from ..resources import Resources
from ..sampling import shutter_samples
from .base import Buffer, Pass

__all__ = ["RayInstancesPass", "RayScenePass"]


class RayScenePass(Pass):
    """Trees of triangles and instances for this frame."""

    name = "ray_scene"
    doc = "refit the trees that rays are traced against"
    scope = "frame_start"

    def rung(self) -> str:
        """When instances are placed."""
        return "once a sample" if shutter_samples(self.request) > 1 else "once a frame"

    def reads(self) -> tuple[str, ...]:
        """Nothing but the scene, whose bound points must be up to date."""
        return ("points",) if self.request.features.bound_meshes else ()

    def writes(self) -> dict[str, Buffer]:
        """The trees live with the device scene."""
        names = ["ray_points"] + ["rays"] * (shutter_samples(self.request) == 1)
        return {name: Buffer(None, 0) for name in names}

    def run(self, resources: Resources) -> None:
        """Bound points; and the instances, unless the shutter moves them."""
        rays = resources.scene.rays()
        rays.add_points(resources.program)
        if shutter_samples(self.request) == 1:
            rays.add_instances(resources.program)

    def bytes_moved(self) -> int:
        """Boxes, inverses and the nodes above them; bound points, faces and the nodes above those."""
        features = self.request.features
        return (
            _instance_bytes(self.request.instances_per_view)
            + features.bound_vertices * (16 + 12)
            + (features.bound_clusters * 128 * (16 + 12 + 24 + 2 * 36))
        )


class RayInstancesPass(Pass):
    """Instances where the shutter has them in a sample."""

    name = "ray_instances"
    doc = "place instances for rays at the sample's time"

    def reads(self) -> tuple[str, ...]:
        """Transforms as the shutter moved them, points of this frame."""
        return ("sample_views", "ray_points")

    def writes(self) -> dict[str, Buffer]:
        """The trees live with the device scene."""
        return {"rays": Buffer(None, 0)}

    def run(self, resources: Resources) -> None:
        """Boxes and inverses, then the nodes above them."""
        resources.scene.rays().add_instances(resources.program)

    def bytes_moved(self) -> int:
        """Boxes, inverses and the nodes above them."""
        return _instance_bytes(self.request.instances_per_view)


def _instance_bytes(count: int) -> int:
    """Records and transforms in, boxes and inverses out, boxes in, nodes out."""
    return count * (96 + 60 + 24 + 36 + 24 + 2 * 36)
