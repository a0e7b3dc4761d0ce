"""The pass of docs/custom-pass.md, word for word, for the bench `effects`; a test compares the two."""

import warp as wp

import warp_deferred as wd

__all__ = ["Fog"]


@wp.kernel
def fog_kernel(
    image: wp.array[wp.vec3],
    depth: wp.array[wp.float32],
    color: wp.vec3,
    density: wp.float32,
    out_image: wp.array[wp.vec3],
):
    i = wp.tid()
    clear = wp.exp(-density * depth[i])  # 0 on the background, whose depth is +inf
    out_image[i] = image[i] * clear + color * (1.0 - clear)


class Fog(wd.Pass):
    """Fog of constant density [1/m]."""

    name = "fog"
    doc = "mix in fog by distance"
    image = "turn"
    after = "shade"

    def __init__(self, color, density):
        self.color, self.density = wp.vec3(*color), density

    def reads(self):
        return ("depth",)

    def run(self, resources):
        channels = resources.channels
        inputs = [channels[self.source], channels["depth"], self.color, self.density]
        resources.program.launch(fog_kernel, self.layout.pixels, inputs, [channels[self.target]], block_dim=64)
