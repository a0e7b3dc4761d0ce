"""Materials, textures, images and samplers of a glTF file.

Factors are linear, base colour and emission textures sRGB, the others linear, as glTF 2.0 section 3.9 has it.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from .gltf_file import GltfFile
from .materials import Material, Texture
from .texture_files import decode_image

__all__ = ["GltfMaterials"]

_WRAPS = {10497: "repeat", 33071: "clamp", 33648: "mirror"}
_NEAREST = 9728
_STRENGTH = "KHR_materials_emissive_strength"


class GltfMaterials:
    """Reads materials on demand; each image is decoded once, each texture made once."""

    def __init__(self, file: GltfFile) -> None:
        self._file, self._report = file, file.report
        self._materials: dict[int | None, Material] = {}
        self._images: dict[int, np.ndarray | None] = {}
        self._textures: dict[tuple[Any, ...], Texture] = {}

    def material(self, index: int | None, where: str) -> Material:
        """Return a material; None is glTF's default material (white, metallic and rough)."""
        if index not in self._materials:
            source = {} if index is None else self._file.item("materials", index, where)
            with self._report.at(where if index is None else f"/materials/{index}"):
                self._materials[index] = self._read(source, f"/materials/{index}")
        return self._materials[index]

    def _read(self, source: dict[str, Any], place: str) -> Material:
        name = str(source.get("name", ""))
        pbr = source.get("pbrMetallicRoughness", {})
        extensions = source.get("extensions", {})
        for extension in extensions:
            if extension != _STRENGTH:
                self._report.note(f"materials: {extension} is not rendered")
        if "normalTexture" in source:
            self._report.note("materials: normal maps are not rendered yet")
        strength = float(extensions.get(_STRENGTH, {}).get("emissiveStrength", 1.0))
        emissive = tuple(float(v) * strength for v in source.get("emissiveFactor", (0.0, 0.0, 0.0)))
        glows = max(emissive) > 0.0
        occlusion = source.get("occlusionTexture")
        mode = str(source.get("alphaMode", "OPAQUE")).lower()
        pbr_place = f"{place}/pbrMetallicRoughness"
        return Material(
            model="ggx",
            base_color=tuple(self._unit(v, place) for v in pbr.get("baseColorFactor", (1.0, 1.0, 1.0, 1.0))),
            metallic=self._unit(pbr.get("metallicFactor", 1.0), place),
            roughness=self._unit(pbr.get("roughnessFactor", 1.0), place),
            emissive=emissive,
            base_color_texture=self._texture(pbr.get("baseColorTexture"), f"{pbr_place}/baseColorTexture", True),
            metallic_roughness_texture=self._texture(
                pbr.get("metallicRoughnessTexture"), f"{pbr_place}/metallicRoughnessTexture", False
            ),
            # An emission factor of zero silences the texture: it is not even decoded.
            emissive_texture=self._texture(source.get("emissiveTexture") if glows else None, f"{place}/emissive", True),
            occlusion_texture=self._texture(occlusion, f"{place}/occlusionTexture", False),
            occlusion_strength=1.0 if occlusion is None else self._unit(occlusion.get("strength", 1.0), place),
            alpha_mode=mode,
            alpha_cutoff=source.get("alphaCutoff", 0.5),
            two_sided=bool(source.get("doubleSided", False)),
            name=name,
        )

    def _unit(self, value: Any, place: str) -> float:
        """Return a factor within 0..1; exporters overshoot now and then."""
        number = float(value)
        if not 0.0 <= number <= 1.0:
            self._report.repair(f"{place}: factor {number:g} lies outside 0..1 and is clamped")
        return min(max(number, 0.0), 1.0)

    def _texture(self, info: dict[str, Any] | None, place: str, srgb: bool) -> Texture | None:
        """Return the texture of a texture info, or None if there is none or its image cannot be used."""
        if info is None:
            return None
        coordinates = info.get("texCoord", 0)
        extensions = info.get("extensions", {})
        if "KHR_texture_transform" in extensions:
            self._report.note("textures: KHR_texture_transform is not applied")
            coordinates = extensions["KHR_texture_transform"].get("texCoord", coordinates)
        if coordinates != 0:
            self._report.note(f"textures: TEXCOORD_{coordinates} is not read; TEXCOORD_0 is used instead")
        source = self._file.item("textures", info["index"], f"{place}/index")
        image = source.get("source", source.get("extensions", {}).get("EXT_texture_webp", {}).get("source"))
        if image is None:
            self._report.repair(f"texture {info['index']} names no image that can be read; it is left out")
            return None
        sampler = {}
        if "sampler" in source:
            sampler = self._file.item("samplers", source["sampler"], f"/textures/{info['index']}/sampler")
        wrap = tuple(self._wrap(sampler.get(key, 10497)) for key in ("wrapS", "wrapT"))
        linear = sampler.get("magFilter") != _NEAREST
        key = (image, wrap, linear, srgb)
        if key not in self._textures:
            pixels = self._image(image, f"/textures/{info['index']}/source")
            if pixels is None:
                return None
            name = str(self._file.items("images")[image].get("name", "")) or f"image {image}"
            self._textures[key] = Texture(pixels, srgb=srgb, wrap=wrap, linear_filter=linear, name=name)
        return self._textures[key]

    def _wrap(self, code: Any) -> str:
        if code not in _WRAPS:
            self._report.note(f"samplers: wrap mode {code!r} is not known; repeat is used")
        return _WRAPS.get(code, "repeat")

    def _image(self, index: Any, where: str) -> np.ndarray | None:
        """Decode an image once; None, with a warning, if that cannot be done."""
        source = self._file.item("images", index, where)
        if index not in self._images:
            place = f"/images/{index}"
            try:
                if "bufferView" in source:
                    data = bytes(self._file.view(source["bufferView"], f"{place}/bufferView")[0])
                else:
                    data = self._file.read_uri(source["uri"], f"{place}/uri")
                self._images[index] = decode_image(data)
            except (OSError, ValueError) as error:
                name = source.get("name") or str(source.get("uri", ""))[:80] or place
                self._report.repair(f"image {name!r} is left out: {error}")
                self._images[index] = None
        return self._images[index]
