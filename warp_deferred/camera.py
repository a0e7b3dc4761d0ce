"""Cameras: where a view stands, how it projects, and what its lens does.

Right-handed, +Y up; a camera looks down its own -Z, +X to the right. Metres and radians. Pixel origin top left,
pixel centres at +0.5. Perspective depth is reversed with an infinite far plane (1 at the near plane, 0 at infinity);
orthographic depth is linear between near and far (1 to 0).
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from pydantic import Field, field_validator, model_validator

from .checks import check_array, check_count, input_error
from .records import Record

__all__ = ["Camera"]

Vector = tuple[float, float, float]
IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)


class Camera(Record):
    """A camera: pose, projection and lens. Immutable; `replace` and the class methods make new ones."""

    position: Vector = (0.0, 0.0, 0.0)
    """World position of the eye [m]; kept in float64."""
    rotation: tuple[float, float, float, float, float, float, float, float, float] = IDENTITY
    """World-to-camera rotation, row-major: its rows are the camera's right, up and backward axes in world space."""
    projection: Literal["perspective", "orthographic"] = "perspective"
    """Perspective or orthographic."""
    vertical_fov: float = Field(
        math.radians(50.0),
        gt=0.0,
        lt=math.pi,
        json_schema_extra={"mend": "an angle in radians between 0 and pi; use math.radians(degrees)"},
    )
    """Full vertical angle of view of a perspective camera [rad]."""
    vertical_extent: float = Field(2.0, gt=0.0)
    """Height of the box an orthographic camera sees [m]."""
    near: float = Field(0.05, description="Distance of the near plane [m]; > 0 for perspective.")
    far: float = Field(1000.0, description="Distance of the far plane [m]; orthographic only, perspective has none.")
    intrinsics: tuple[float, float, float, float] | None = None
    """(fx, fy, cx, cy) in pixels of an image of `image_size`, origin top left; overrides the angle or extent."""
    image_size: tuple[int, int] | None = None
    """(width, height) the intrinsics were measured at [px]; a render of another size scales them."""
    world: int = Field(-1, ge=-1)
    """The world this camera sees; -1 sees all."""
    exposure: float = Field(0.0, ge=-64.0, le=64.0)
    """Exposure [stops]: `display` is scaled by 2^exposure."""
    aperture: float = Field(0.0, ge=0.0)
    """Diameter of the lens opening [m]; 0 is a pinhole. Orthographic cameras have none: all they see is in focus."""
    focus_distance: float = Field(1.0, gt=0.0)
    """View depth of the plane in focus [m]."""
    shutter: float = Field(0.0, ge=0.0, le=1.0)
    """Time the shutter stays open, as a share of the frame interval, 0 to 1; it closes at the frame's own time."""
    bloom: float = Field(0.0, ge=0.0, le=1.0)
    """Share of light the lens scatters into a bloom [1]; with a threshold in force, of the light above it."""
    name: str = ""
    """Name, as in the file it came from."""

    @field_validator("rotation")
    @classmethod
    def _orthonormal(cls, rotation: tuple[float, ...]) -> tuple[float, ...]:
        if rotation == IDENTITY:
            return rotation
        matrix = np.array(rotation).reshape(3, 3)
        if not np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-4) or np.linalg.det(matrix) < 0.0:
            raise input_error(
                "Camera.rotation", "a right-handed orthonormal matrix", rotation, "use Camera.look_at or from_matrix"
            )
        return rotation

    @model_validator(mode="after")
    def _planes(self) -> Camera:
        if self.projection == "perspective" and not self.near > 0.0:
            raise input_error(
                "Camera.near",
                "a value > 0 [m] for a perspective camera",
                self.near,
                "the usual 0.05 keeps all depth precision",
            )
        if self.projection == "orthographic" and not self.far > self.near:
            raise input_error(
                "Camera.far",
                f"a value > near = {self.near:g} [m]",
                self.far,
                "move the far plane behind the near plane",
            )
        if self.intrinsics is not None:
            if self.image_size is None:
                raise input_error(
                    "Camera.image_size",
                    "(width, height) beside intrinsics",
                    None,
                    "say which image the intrinsics belong to",
                )
            if min(self.intrinsics[:2]) <= 0.0 or min(self.image_size) <= 0:
                raise input_error(
                    "Camera.intrinsics", "focal lengths and image size > 0 [px]", (self.intrinsics, self.image_size)
                )
        # Made with the camera, and not in the frame that first shows it.
        _ = self.selector
        return self

    @classmethod
    def look_at(
        cls, eye: Sequence[float], target: Sequence[float], *, up: Sequence[float] = (0.0, 1.0, 0.0), **fields: Any
    ) -> Camera:
        """Stand at `eye` and look at `target`.

        An `up` that is parallel to the view direction is replaced by the world axis least aligned with it.

        Args:
            eye: World position of the eye [m].
            target: World position in the middle of the picture [m].
            up: Direction that points up in the picture.
            **fields: Any other field of `Camera`; `vertical_fov_deg` gives the angle in degrees.

        Raises:
            InputError: If eye and target coincide or a number is not finite.
        """
        e = check_array("Camera.look_at.eye", eye, (3,), np.float64)
        t = check_array("Camera.look_at.target", target, (3,), np.float64)
        u = check_array("Camera.look_at.up", up, (3,), np.float64)
        back = e - t
        length = math.sqrt(float(back @ back))
        if not length > 0.0:
            raise input_error(
                "Camera.look_at.target",
                "a point other than the eye",
                tuple(map(float, target)),
                "move the target away from the eye",
            )
        back /= length
        right = np.cross(u, back)
        norm = math.sqrt(float(right @ right))
        if norm <= 1e-6 * math.sqrt(float(u @ u)):
            axis = np.zeros(3)
            axis[int(np.argmin(np.abs(back)))] = 1.0
            right = np.cross(axis, back)
            norm = math.sqrt(float(right @ right))
        right /= norm
        rows = (*right.tolist(), *np.cross(back, right).tolist(), *back.tolist())
        if "vertical_fov_deg" in fields:
            fields["vertical_fov"] = math.radians(fields.pop("vertical_fov_deg"))
        return cls(position=tuple(e.tolist()), rotation=rows, **fields)

    @classmethod
    def from_matrix(cls, camera_to_world: Any, **fields: Any) -> Camera:
        """Take the pose from a 4x4 camera-to-world matrix in our axes (-Z forward, +Y up); scale is dropped."""
        m = check_array("Camera.from_matrix", camera_to_world, (4, 4), np.float64)
        x, y = m[:3, 0], m[:3, 1]
        norm_x = np.linalg.norm(x)
        if not norm_x > 0.0 or not np.linalg.norm(np.cross(x, y)) > 0.0:
            raise input_error("Camera.from_matrix", "an invertible pose", m.tolist(), "check the upper 3x3 part")
        right = x / norm_x
        back = np.cross(right, y)
        back /= np.linalg.norm(back)
        rows = (*right.tolist(), *np.cross(back, right).tolist(), *back.tolist())
        return cls(position=tuple(m[:3, 3].tolist()), rotation=rows, **fields)

    @classmethod
    def from_intrinsics(cls, K: Any, width: int, height: int, pose: Any = None, **fields: Any) -> Camera:
        """Take a calibrated camera in the OpenCV convention (+Z forward, +Y down).

        OpenCV puts pixel centres at whole numbers; half a pixel is added to the principal point.

        Args:
            K: 3x3 matrix [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels; cx, cy may lie anywhere.
            width: Width of the image K was measured at [px].
            height: Height of that image [px].
            pose: 4x4 camera-to-world matrix in OpenCV axes; the identity if left out.
            **fields: Any other field of `Camera`. Lens distortion is not modelled and refused by name.

        Raises:
            InputError: If K has skew, a focal length is not positive, or distortion is handed in.
        """
        for name in ("distortion", "dist_coeffs", "D", "k1", "k2", "k3", "p1", "p2"):
            if name in fields:
                raise input_error(
                    f"Camera.from_intrinsics.{name}",
                    "no lens distortion (not modelled)",
                    fields[name],
                    "undistort the images first, or leave it out",
                )
        k = check_array("Camera.from_intrinsics.K", K, (3, 3), np.float64)
        if k[0, 1] != 0.0 or k[1, 0] != 0.0 or not np.array_equal(k[2], (0.0, 0.0, 1.0)):
            raise input_error(
                "Camera.from_intrinsics.K", "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]", k.tolist(), "skew is not supported"
            )
        size = (
            check_count("Camera.from_intrinsics.width", width, 1, 1 << 20),
            check_count("Camera.from_intrinsics.height", height, 1, 1 << 20),
        )
        flip = np.diag([1.0, -1.0, -1.0, 1.0])
        matrix = (
            np.eye(4) if pose is None else check_array("Camera.from_intrinsics.pose", pose, (4, 4), np.float64)
        ) @ flip
        numbers = (float(k[0, 0]), float(k[1, 1]), float(k[0, 2]) + 0.5, float(k[1, 2]) + 0.5)
        return cls.from_matrix(matrix, intrinsics=numbers, image_size=size, **fields)

    @functools.cached_property
    def selector(self) -> int:
        """World and lens in one number: all of a camera that can select another plan."""
        return 8 * self.world + self.has_lens + 2 * (self.shutter > 0.0) + 4 * (self.bloom > 0.0)

    @property
    def has_lens(self) -> bool:
        """Whether it blurs what is out of focus; parallel rays, which have no centre to open up, never do."""
        return self.aperture > 0.0 and self.projection == "perspective"

    @property
    def lens_flags(self) -> int:
        """What the lens calls for: 1 for an aperture, 2 for a shutter, 4 for bloom, joined."""
        return self.selector & 7

    def pixel_projection(self, width: int, height: int) -> tuple[float, float, float, float]:
        """Return (fx, fy, cx, cy) [px] for an image of that size: x_px = fx x / -z + cx, y_px = -fy y / -z + cy.

        For an orthographic camera fx and fy are pixels per metre and the division is by one.
        """
        if self.intrinsics is not None:
            fx, fy, cx, cy = self.intrinsics
            sx, sy = width / self.image_size[0], height / self.image_size[1]
            return fx * sx, fy * sy, cx * sx, cy * sy
        if self.projection == "perspective":
            focal = 0.5 * height / math.tan(0.5 * self.vertical_fov)
        else:
            focal = height / self.vertical_extent
        return focal, focal, 0.5 * width, 0.5 * height
