"""Materials of OBJ files (MTL), in the classic models.

MTL colours have no stated colour space; by custom they are what a display shows, so Kd, Ks and Ke are decoded from
sRGB to linear light here. Ks and Ns give `blinn_phong`; a black Ks, or illum 0 or 1, gives `lambert`.
Surfaces are two-sided: the format knows no back-face culling, and its files are wound in either way.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from .gltf_file import local_file
from .load_report import LoadReport
from .materials import Material, Texture
from .mesh_repair import linear_from_srgb
from .texture_files import decode_image

__all__ = ["file_texture", "read_mtl"]

#: How many words follow each option of a map statement.
_OPTIONS = {
    "-blendu": 1,
    "-blendv": 1,
    "-boost": 1,
    "-cc": 1,
    "-clamp": 1,
    "-bm": 1,
    "-imfchan": 1,
    "-texres": 1,
    "-mm": 2,
}
_TRIPLES = ("-o", "-s", "-t")


def read_mtl(folder: Path, libraries: list[str], report: LoadReport) -> dict[str, Material]:
    """Read material files that lie beside an OBJ file; one that cannot be read costs a warning.

    Args:
        folder: Folder of the OBJ file.
        libraries: What its mtllib lines say: one name each, or several.
        report: Where remarks go.
    """
    materials: dict[str, Material] = {}
    textures: dict[tuple[str, str], Texture | None] = {}
    for line in libraries:
        names = [line] if line.lower().endswith(".mtl") and line.lower().count(".mtl") == 1 else line.split()
        for name in names:
            try:
                text = local_file(folder, name.replace("%", "%25")).read_text("utf-8", errors="replace")
            except (OSError, ValueError) as error:
                report.repair(f"material file {name!r} is left out: {error}")
                continue
            for key, fields in _statements(text).items():
                with report.at(f"{name}, material {key!r}", "MTL statements with numbers"):
                    materials[key] = _material(key, fields, folder, textures, report)
    return materials


def _statements(text: str) -> dict[str, dict[str, str]]:
    """Return material name -> lower-case keyword -> the rest of its line; a later statement replaces an earlier one."""
    found: dict[str, dict[str, str]] = {}
    fields: dict[str, str] = {}
    for line in text.splitlines():
        words = line.split("#", 1)[0].strip().split(None, 1)
        if len(words) < 2:
            continue
        if words[0].lower() == "newmtl":
            fields = found.setdefault(" ".join(words[1].split()), {})
        else:
            fields[words[0].lower()] = words[1].strip()
    return found


def _material(
    name: str,
    fields: dict[str, str],
    folder: Path,
    textures: dict[tuple[str, str], Texture | None],
    report: LoadReport,
) -> Material:
    diffuse = _color(fields.get("kd", "0.8 0.8 0.8"))
    specular = _color(fields.get("ks", "0 0 0"))
    texture = None
    if "map_kd" in fields:
        file, wrap = _map(fields["map_kd"])
        if (file, wrap) not in textures:
            textures[file, wrap] = file_texture(folder, file, report, wrap=wrap)
        texture = textures[file, wrap]
        if texture is not None and max(diffuse) == 0.0:
            report.note(f"material {name!r}: a black Kd would hide its texture; white is used")
            diffuse = (1.0, 1.0, 1.0)
    for key in fields:
        if key.startswith(("map_", "bump", "norm", "disp", "refl", "decal")) and key != "map_kd":
            report.note(f"materials: {key} is not rendered")
    alpha = _alpha(name, fields, report)
    shiny = max(specular) > 0.0 and fields.get("illum", "2").strip() not in ("0", "1")
    options: dict[str, Any] = {}
    if shiny:
        options = {"specular": specular, "shininess": min(max(float(fields.get("ns", "32").split()[0]), 1.0), 8192.0)}
    return Material(
        model="blinn_phong" if shiny else "lambert",
        base_color=(*diffuse, alpha),
        emissive=_color(fields.get("ke", "0 0 0")),
        base_color_texture=texture,
        alpha_mode="opaque" if alpha == 1.0 else "blend",
        two_sided=True,
        name=name,
        **options,
    )


def _alpha(name: str, fields: dict[str, str], report: LoadReport) -> float:
    """Return opacity from d or Tr = 1 - d; exporters disagree on Tr, and Tr 1 would hide the surface: it is opaque."""
    if "d" in fields:
        return min(max(float(fields["d"].split()[-1]), 0.0), 1.0)
    transparency = float(fields.get("tr", "0").split()[0])
    if transparency >= 1.0:
        report.note(f"material {name!r}: Tr {transparency:g} would make it invisible; it is taken as opaque")
        return 1.0
    return 1.0 - max(transparency, 0.0)


def _color(text: str) -> tuple[float, float, float]:
    """Return linear light of one (grey) or three display values; spectral and xyz forms are errors of the number."""
    numbers = [min(max(float(word), 0.0), 1.0) for word in text.split()[:3]]
    if len(numbers) < 3:
        numbers = [numbers[0]] * 3
    return tuple(linear_from_srgb(numbers).tolist())


def _map(text: str) -> tuple[str, str]:
    """Return (file, wrap mode) of a map statement; the name is what follows the options, blanks included."""
    wrap, rest = "repeat", text
    while match := re.match(r"(-[a-z]+)\s+", rest):
        option, rest = match[1], rest[match.end() :]
        limit = 3 if option in _TRIPLES else _OPTIONS.get(option, 0)
        for _ in range(limit):
            word, _, after = rest.partition(" ")
            # Triples may be cut short: they end at the first word that is no number.
            if option in _TRIPLES and not re.fullmatch(r"[-+.\deE]+", word):
                break
            if option == "-clamp" and word == "on":
                wrap = "clamp"
            rest = after.lstrip()
    return rest, wrap


def file_texture(folder: Path, name: str, report: LoadReport, *, wrap: str = "repeat") -> Texture | None:
    """Return the sRGB texture in a file beside the model, or None, with a warning, if there is none to be had."""
    try:
        pixels = decode_image(local_file(folder, name.replace("\\", "/").replace("%", "%25")).read_bytes())
    except (OSError, ValueError) as error:
        report.repair(f"image {name!r} is left out: {error}")
        return None
    return Texture(pixels, wrap=(wrap, wrap), name=name)
