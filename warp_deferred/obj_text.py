"""Wavefront OBJ text, checked and rewritten into the plain form that trimesh reads exactly.

trimesh wraps index 0 round to the last vertex, cuts every polygon into a fan, drops all texture coordinates of a
material when one face lacks them, and fails as a whole on one index out of range. So the faces are checked here line
by line and come out as triangles with absolute indices, all in one form; numbers are left for trimesh to parse.
A face that lacks uvs or normals where others have them gets (0, 0) and the zero normal (the face's own).
"""

from __future__ import annotations

import re

import numpy as np

from .load_report import LoadReport
from .polygons import triangulate_polygon

__all__ = ["MATERIAL_FILE", "MATERIAL_NAME", "ObjText"]

#: Name under which the rewritten text asks for its materials: trimesh hands back their names only if one answers.
MATERIAL_FILE = "materials.mtl"
#: How the rewritten text calls materials: numbered, so that blanks and odd characters in their names do no harm.
MATERIAL_NAME = "material<{}>"

#: What old Microsoft compilers print for numbers that are not finite, such as 1.#QNAN or -1.#IND.
_NOT_A_NUMBER = re.compile(r"-?\d\.#[A-Za-z]+\w*")
_KEYWORDS = frozenset(
    "v vt vn vp f l p o g s usemtl mtllib cstype deg curv curv2 surf parm trim hole scrv sp end con bmat step "
    "bevel c_interp d_interp lod shadow_obj trace_obj ctech stech fo mg usemap maplib call csh".split()
)


class ObjText:
    """One OBJ file's text, rewritten.

    Attributes:
        text: The plain form.
        libraries: Names of material files, in order.
        materials: Names of materials in use, in order.
        has_normals: Whether any face names a normal.
    """

    def __init__(self, data: bytes, report: LoadReport) -> None:
        self._report = report
        self.libraries: list[str] = []
        self.materials: list[str] = []
        self._lines: list[str] = []
        self._points: list[str] = []
        self._colored = 0
        self._counts = {"v": 0, "vt": 0, "vn": 0}
        self._corners: list[list[tuple[int, int, int]]] = []
        self._places: list[int] = []
        self._dropped = 0
        if b"\0" in data[:4096]:
            raise report.error("", "OBJ text", "binary data", "check that the file is an OBJ file")
        text = data.decode("utf-8", errors="replace").replace("\\\r\n", " ").replace("\\\n", " ")
        if "#" in text:
            text = _NOT_A_NUMBER.sub("nan", text)
        unknown = self._read(text)
        if unknown and not any(self._counts.values()) and not self._corners:
            raise report.error("", "OBJ text", f"a line {unknown[:60]!r}", "check that the file is an OBJ file")
        self.has_normals = any(c[2] for face in self._corners for c in face)
        self._has_uvs = any(c[1] for face in self._corners for c in face)
        self.text = self._rewrite()

    def material_number(self, name: str | None) -> int | None:
        """Return which of `materials` a name in the rewritten text stands for; None for others."""
        match = re.fullmatch(re.escape(MATERIAL_NAME).replace(r"\{\}", r"(\d+)"), name or "")
        return int(match[1]) if match else None

    def _read(self, text: str) -> str:
        """Sort lines into points, faces and names; returns the first line of an unknown kind."""
        unknown = ""
        for number, line in enumerate(text.splitlines(), 1):
            words = line.split("#", 1)[0].split()
            if not words:
                continue
            key = words[0]
            if key == "v":
                self._point(words, number)
            elif key in ("vt", "vn"):
                self._counts[key] += 1
                width = 2 if key == "vt" else 3
                self._lines.append(" ".join([key, *words[1 : 1 + width], *["0"] * (1 + width - len(words))]))
            elif key == "f":
                self._face(words[1:], number)
            elif key == "o":
                self._lines.append("o " + " ".join(words[1:]))
            elif key == "usemtl":
                name = " ".join(words[1:])
                if name not in self.materials:
                    self.materials.append(name)
                self._lines.append("usemtl " + MATERIAL_NAME.format(self.materials.index(name)))
            elif key == "mtllib":
                self.libraries.append(line.split("#", 1)[0].strip()[6:].strip())
            elif key in ("l", "p"):
                self._report.note("points and lines are not rendered")
            elif key not in _KEYWORDS:
                unknown = unknown or line
        return unknown

    def _point(self, words: list[str], number: int) -> None:
        if len(words) < 4:
            raise self._report.error(f"line {number}", "v x y z", " ".join(words), "give three coordinates")
        self._counts["v"] += 1
        # Four numbers are x y z w, six or more x y z r g b.
        self._colored += len(words) >= 7
        self._points.append(" ".join(words[1:7] if len(words) >= 7 else words[1:4]))

    def _face(self, words: list[str], number: int) -> None:
        if len(words) < 3:
            self._report.note("faces with fewer than three corners are not rendered")
            return
        try:
            corners = [self._corner(word, number) for word in words]
        except ValueError:
            raise self._report.error(
                f"line {number}", "corners v, v/vt, v//vn or v/vt/vn", "f " + " ".join(words), "correct the face"
            ) from None
        self._places.append(len(self._lines))
        self._lines.append("")
        self._corners.append(corners)

    def _corner(self, word: str, number: int) -> tuple[int, int, int]:
        """Return absolute one-based (v, vt, vn); 0 stands for an absent vt or vn, -1 for a v before the first."""
        fields = word.split("/")
        found = []
        for field, key in zip(fields[:3], ("v", "vt", "vn"), strict=False):
            if not field and key != "v":
                found.append(0)
                continue
            index = int(field)
            if index == 0:
                raise self._report.error(
                    f"line {number}", f"{key} indices from 1, or -1 and below", f"0 in {word!r}", "OBJ counts from one"
                )
            if index < 0:
                index += self._counts[key] + 1
                index = index if index > 0 else -1
            found.append(index)
        return (*found, *[0] * (3 - len(found)))

    def _rewrite(self) -> str:
        points = self._points
        if 0 < self._colored < len(points):
            points = [p if p.count(" ") >= 5 else p + " 1 1 1" for p in points]
        count, uv_count, normal_count = self._counts["v"], self._counts["vt"], self._counts["vn"]
        # One-based numbers of the two defaults, which are appended to the lists.
        no_uv, no_normal = uv_count + 1, normal_count + 1
        positions: np.ndarray | None = None
        for place, face in zip(self._places, self._corners, strict=True):
            if any(not 0 < corner[0] <= count for corner in face):
                self._dropped += 1
                continue
            words = []
            for v, vt, vn in face:
                t = str(vt if 0 < vt <= uv_count else no_uv) if self._has_uvs else ""
                n = str(vn if 0 < vn <= normal_count else no_normal) if self.has_normals else ""
                words.append(f"{v}/{t}/{n}" if n else f"{v}/{t}" if t else str(v))
            if len(face) == 3:
                self._lines[place] = "f " + " ".join(words)
                continue
            positions = self._positions() if positions is None else positions
            cut = triangulate_polygon(positions[[corner[0] - 1 for corner in face]])
            self._lines[place] = "\n".join(f"f {words[a]} {words[b]} {words[c]}" for a, b, c in cut)
        if self._dropped:
            plural = "face" if self._dropped == 1 else "faces"
            self._report.repair(f"dropped {self._dropped} {plural} with an index outside its {count} vertices")
        head = [f"mtllib {MATERIAL_FILE}"] if self.materials else []
        vertices = ["v " + p for p in points]
        defaults = (["vt 0 1"] if self._has_uvs else []) + (["vn 0 0 0"] if self.has_normals else [])
        attributes = [line for line in self._lines if line.startswith("v")]
        rest = [line for line in self._lines if line and not line.startswith("v")]
        return "\n".join(head + vertices + attributes + defaults + rest) + "\n"

    def _positions(self) -> np.ndarray:
        with self._report.at("vertices", "three numbers in each"):
            return np.array([[float(x) for x in point.split()[:3]] for point in self._points], np.float64)
