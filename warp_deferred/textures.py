"""Textures on the device: linear 16-bit texels with mips, so that filtering happens in linear light."""

from __future__ import annotations

import numpy as np
import warp as wp

from .materials import Texture

__all__ = ["TextureStore"]

WRAP_MODES = {
    "repeat": wp.TextureAddressMode.WRAP,
    "clamp": wp.TextureAddressMode.CLAMP,
    "mirror": wp.TextureAddressMode.MIRROR,
}
WRAP_CODES = {"repeat": 0, "clamp": 1, "mirror": 2}


def srgb_to_linear16() -> np.ndarray:
    """(256,) uint16: linear value of each sRGB code, of 65535 (IEC 61966-2-1)."""
    code = np.arange(256) / 255.0
    linear = np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)
    return np.round(linear * 65535.0).astype(np.uint16)


def linear_texels(texture: Texture) -> np.ndarray:
    """(height, width, 4) uint16 linear colour and alpha; grey is spread over the colours, missing alpha is 1."""
    pixels = texture.pixels
    channels = pixels.shape[2]
    color = np.repeat(pixels[:, :, :1], 3, axis=2) if channels < 3 else pixels[:, :, :3]
    out = np.full((*pixels.shape[:2], 4), 65535, np.uint16)
    out[:, :, :3] = srgb_to_linear16()[color] if texture.srgb else color.astype(np.uint16) * 257
    if channels in (2, 4):
        out[:, :, 3] = pixels[:, :, channels - 1].astype(np.uint16) * 257
    return out


class TextureStore:
    """Uploads each texture once."""

    def __init__(self, device: wp.Device) -> None:
        self._device = device
        self._filtered: dict[int, tuple[Texture, wp.Texture2D]] = {}
        self._masks: dict[int, tuple[Texture, wp.Texture2D]] = {}
        self.bytes = 0

    def filtered(self, texture: Texture) -> wp.Texture2D:
        """Linear texels with a full mip chain and the texture's wrap and filter modes."""
        if id(texture) not in self._filtered:
            texels = linear_texels(texture)
            mode = wp.TextureFilterMode.LINEAR if texture.linear_filter else wp.TextureFilterMode.CLOSEST
            made = wp.Texture2D(
                texels,
                num_mip_levels=0,
                filter_mode=mode,
                mip_filter_mode=wp.TextureFilterMode.LINEAR,
                address_mode_u=WRAP_MODES[texture.wrap[0]],
                address_mode_v=WRAP_MODES[texture.wrap[1]],
                device=self._device,
            )
            self._filtered[id(texture)] = (texture, made)
            self.bytes += texels.nbytes * 4 // 3
        return self._filtered[id(texture)][1]

    def mask(self, texture: Texture) -> wp.Texture2D:
        """Alpha alone, exact texels."""
        if id(texture) not in self._masks:
            alpha = np.ascontiguousarray(linear_texels(texture)[:, :, 3])
            made = wp.Texture2D(alpha, filter_mode=wp.TextureFilterMode.CLOSEST, device=self._device)
            self._masks[id(texture)] = (texture, made)
            self.bytes += alpha.nbytes
        return self._masks[id(texture)][1]
