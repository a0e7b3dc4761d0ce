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
#: Index that no file has a vertex for.
_FAR = 1 << 62
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
    """

    def __init__(self, data: bytes, report: LoadReport) -> None:
        self._report = report
        self.libraries: list[str] = []
        self.materials: list[str] = []
        self._lines: list[str] = []
        self._points: list[str] = []
        self._colored = 0
        self._counts = {"v": 0, "vt": 0, "vn": 0}
        # Flat lists, a list for each face would cost more than all the rest: the words of all corners, and of each
        # face the number of its corners, its place among `_lines`, its line, and how many v, vt, vn came before.
        self._words: list[str] = []
        self._lengths: list[int] = []
        self._places: list[int] = []
        self._numbers: list[int] = []
        self._before: list[int] = []
        if b"\0" in data[:4096]:
            raise report.error("", "OBJ text", "binary data", "check that the file is an OBJ file")
        text = data.decode("utf-8", errors="replace").replace("\\\r\n", " ").replace("\\\n", " ")
        if "#" in text:
            text = _NOT_A_NUMBER.sub("nan", text)
        unknown = self._read(text)
        if unknown and not any(self._counts.values()) and not self._lengths:
            raise report.error("", "OBJ text", f"a line {unknown[:60]!r}", "check that the file is an OBJ file")
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
        self._words += words
        self._lengths.append(len(words))
        self._places.append(len(self._lines))
        self._numbers.append(number)
        self._before += self._counts.values()
        self._lines.append("")

    def _corners(self) -> np.ndarray:
        """Return all corners, (n, 3): absolute one-based v, vt, vn; 0 for none, -1 for one before the first."""
        words = self._words
        values = np.zeros((len(words), 3), np.int64)
        if not words:
            return values
        slashes = words[0].count("/")
        uniform = slashes <= 2 and all(word.count("/") == slashes for word in words)
        joined = " ".join(words)
        gap = "//" in joined
        try:
            if not uniform or (gap and joined.count("//") != len(words)):
                raise ValueError
            columns = [0, 2] if gap else list(range(slashes + 1))
            numbers = np.array(joined.replace("/", " ").split(), dtype=np.str_).astype(np.int64)
            values[:, columns] = numbers.reshape(len(words), len(columns))
            given = np.zeros(3, bool)
            given[columns] = True
        except (ValueError, OverflowError):
            values, given = self._mixed_corners()
        self._refuse_zeros(words, values, given)
        before = np.repeat(np.array(self._before, np.int64).reshape(-1, 3), self._lengths, axis=0)
        absolute = np.where(values < 0, values + before + 1, values)
        return np.where((values < 0) & (absolute <= 0), -1, absolute)

    def _mixed_corners(self) -> tuple[np.ndarray, np.ndarray]:
        """Parse faces that do not all have one form, word by word; returns numbers and which of them are given."""
        rows, given = [], []
        for word in self._words:
            fields = [*word.split("/")[:3], "", ""][:3]
            try:
                # Beyond any count of vertices one index is as good as another.
                rows.append([max(-_FAR, min(int(field or 0), _FAR)) for field in (fields[0] or "none", *fields[1:])])
            except ValueError:
                line, forms = self._line_of(len(rows)), "corners v, v/vt, v//vn or v/vt/vn"
                raise self._report.error(f"line {line}", forms, repr(word), "correct the face") from None
            given.append([True, fields[1] != "", fields[2] != ""])
        return np.array(rows, np.int64), np.array(given, bool)

    def _line_of(self, corner: int) -> int:
        """Return the line of the face that a corner belongs to."""
        return self._numbers[int(np.searchsorted(np.cumsum(self._lengths), corner, side="right"))]

    def _refuse_zeros(self, words: list[str], values: np.ndarray, given: np.ndarray) -> None:
        zeros = (values == 0) & given
        if zeros.any():
            corner, column = np.argwhere(zeros)[0]
            line = self._line_of(int(corner))
            raise self._report.error(
                f"line {line}",
                f"{('v', 'vt', 'vn')[column]} indices from 1, or -1 and below",
                f"0 in {words[corner]!r}",
                "OBJ counts from one",
            )

    def _rewrite(self) -> str:
        points = self._points
        if 0 < self._colored < len(points):
            points = [p if p.count(" ") >= 5 else p + " 1 1 1" for p in points]
        limits = np.array(list(self._counts.values()))
        corners = self._corners()
        has_uvs, has_normals = (bool((corners[:, k] != 0).any()) for k in (1, 2))
        inside = (corners[:, 0] > 0) & (corners[:, 0] <= limits[0])
        # Uvs and normals that are missing or out of range become the two defaults that are appended to the lists.
        whole = (corners > 0) & (corners <= limits)
        corners = np.where(whole, corners, limits + 1)
        self._write_faces(corners, inside, has_uvs, has_normals)
        head = [f"mtllib {MATERIAL_FILE}"] if self.materials else []
        vertices = ["v " + p for p in points]
        defaults = (["vt 0 1"] if has_uvs else []) + (["vn 0 0 0"] if has_normals else [])
        attributes = [line for line in self._lines if line.startswith("v")]
        rest = [line for line in self._lines if line and not line.startswith("v")]
        return "\n".join(head + vertices + attributes + defaults + rest) + "\n"

    def _write_faces(self, corners: np.ndarray, inside: np.ndarray, has_uvs: bool, has_normals: bool) -> None:
        """Put each face's triangles into its place among the lines; faces that name no vertex are left out."""
        v, vt, vn = (corners[:, k].tolist() for k in range(3))
        if has_uvs and has_normals:
            words = [f"{a}/{b}/{c}" for a, b, c in zip(v, vt, vn, strict=True)]
        elif has_uvs or has_normals:
            slashes = "/" if has_uvs else "//"
            words = [f"{a}{slashes}{b}" for a, b in zip(v, vt if has_uvs else vn, strict=True)]
        else:
            words = [str(a) for a in v]
        usable = inside.tolist()
        positions: np.ndarray | None = None
        start = dropped = 0
        for length, place in zip(self._lengths, self._places, strict=True):
            end = start + length
            if not all(usable[start:end]):
                dropped += 1
            elif length == 3:
                self._lines[place] = f"f {words[start]} {words[start + 1]} {words[start + 2]}"
            else:
                positions = self._positions() if positions is None else positions
                cut = triangulate_polygon(positions[corners[start:end, 0] - 1])
                face = words[start:end]
                self._lines[place] = "\n".join(f"f {face[a]} {face[b]} {face[c]}" for a, b, c in cut.tolist())
            start = end
        if dropped:
            plural = "face" if dropped == 1 else "faces"
            self._report.repair(f"dropped {dropped} {plural} with an index outside its {self._counts['v']} vertices")

    def _positions(self) -> np.ndarray:
        with self._report.at("vertices", "three numbers in each"):
            return np.array([point.split()[:3] for point in self._points], np.str_).astype(np.float64)
