"""What docs/effects.md says of each case in words: what it shows, what cheap rungs get wrong, which rung to choose."""

from __future__ import annotations

__all__ = ["TEXTS", "TITLES"]

#: Case -> heading, where its name does not say it.
TITLES = {
    "ambient_visibility_terrain": "ambient_visibility, over a terrain",
    "shadow_cascades": "shadow, four cascades over a terrain",
    "scale": "scale, without anti-aliasing",
    "scale_samples_16": "scale, with samples_16",
    "tone_mapping": "tone mapping",
    "custom_pass": "a pass of your own",
}
#: Case -> one paragraph.
TEXTS: dict[str, str] = {
    "shadow": (
        "A courtyard under a sun, a lamp and a moon, one light of each kind. `hard` compares with one texel and shows "
        "it: edges are stairs as coarse as the map. `pcf`, the default, smooths them over four texels, equally "
        "everywhere, so that the far end of a shadow is as sharp as its foot. `pcss` widens the edge with the distance "
        "to what casts it and comes near the reference but for where penumbrae of several things overlap. Choose "
        "`pcf` for small or distant lights, `pcss` where penumbrae are seen, `ray_traced` to check them or for a still."
    ),
    "shadow_cascades": (
        "What a directional light costs in a large scene: four maps of 2048 x 2048 texels over all triangles of a "
        "terrain, drawn anew in every frame. Drawing shows in `raster` and `clusters`, filtering in `shade`. With "
        "`shadow.keep_maps`, the default, a still light over still ground pays for filtering only."
    ),
    "ambient_visibility": (
        "A jointed figure on a crate in the corner of a room. "
        "`ssao` darkens corners softly and misses the depth of contacts: its difference is bright where things touch. "
        "`gtao_half` puts the darkness where it belongs, with blocky rims around the figure; `gtao`, the default, has "
        "finer ones. All three know only the depths in the picture: gaps between boards, where light is blocked by "
        "what the camera cannot see, stay too bright, and a thin arm may darken the wall far behind it. Choose "
        "`gtao_half` where time counts, `gtao` otherwise, `ray_traced` where the number itself is wanted."
    ),
    "ambient_visibility_terrain": (
        "What it costs out of doors, on the terrain that whole frames are timed on: 62 % of the pixels show a surface, "
        "and few of them have anything near. In `corner`, above, every pixel does and is near something, which is as "
        "dear as it gets. Lights are culled meanwhile, as another branch of the graph."
    ),
    "bloom": (
        "Neon rings, tubes and embers brighter than white. `neighbourhood` spreads light over one small window only: "
        "close to the lamps it glows, as squares, and the wide veil is missing. `mip_chain`, the default, has both; "
        "what differs from `exact` are single bright pixels, which it damps so that they do not flicker "
        "(`bloom.fireflies`). Choose `mip_chain`; `exact` is its measure and costs thousands of operations a pixel."
    ),
    "depth_of_field": (
        "A row of things through the plane in focus, and bulbs far behind it. `plane_lerp` mixes in one blurred copy: "
        "bulbs become haze around a sharp core, and sharp edges get halos. `gather`, the default, draws the lens's "
        "circles and keeps the sphere in focus sharp; it has to guess what a blurred thing in front hides, which shows "
        "along the urn close to the lens. Choose `gather`; `lens_samples` for stills, since it costs so many frames."
    ),
    "motion_blur": (
        "A spinning wheel and a ball that flies behind a post. `velocity_gather`, the default, blurs along straight "
        "lines, so that fast rotation keeps a little of the polygon, and spokes a pixel wide carry the stairs of "
        "the one image it has; what a moving thing uncovers is guessed. `shutter_samples` moves the things themselves. "
        "Choose `velocity_gather`, best with samples of `anti_aliasing`; `shutter_samples` for stills."
    ),
    "anti_aliasing": (
        "Columns and a lamp, a pixel shown three by three. `fxaa` smooths the long edges for next to nothing; what the "
        "pixels' centres missed stays missing, such as the thin ledge on the wall, and fine details get softer. "
        "`samples_4` mends both, and from `samples_16` on one has to look for the difference. Choose `fxaa` for "
        "interaction, `samples_4` or `samples_16` for pictures that are kept."
    ),
    "scale": (
        "Fewer pixels are rendered and `display` is scaled up along its edges; the reference is the full size, rung "
        "`off`. Without anti-aliasing, stairs of the small picture are larger than those of the full one, and details "
        "thinner than a pixel come and go: lamps and thin ledges differ most. Rungs are words, as all "
        "rungs are: the neutral one is called `off`, and two thirds is no number of three digits."
    ),
    "scale_samples_16": (
        "The same with sixteen samples a pixel: now the small picture knows what is in each of its pixels, and what is "
        "left is softness. Choose `two_thirds` with samples where time is short; `half` shows in textures and lamps."
    ),
    "blur": (
        "A Gaussian over the whole image in linear light, before exposure and tone mapping, so that lamps stay bright "
        "when they spread. It is a filter, no ladder: there is no rung nearer to the truth. `blur.sigma_px` is its "
        "width; the same code serves passes of your own ([custom-pass.md](custom-pass.md))."
    ),
    "tone_mapping": (
        "Curves of `display.tone_mapping` on one scene with much light above white. It is a choice, no ladder: `off` "
        "clips, so that a bright pink ring keeps its hue and loses its form; `reinhard` and `aces` compress each "
        "channel; `pbr_neutral`, the default, leaves what is below white as the materials say; `agx` takes the "
        "colour out of what is very bright, as film does. It is part of `display` and costs nothing of its own to "
        "speak of."
    ),
    "custom_pass": (
        "The worked example of [custom-pass.md](custom-pass.md), twenty lines of Python and a kernel, handed in with "
        "`passes=`. Its cost beside its own launch: with a pass of a user's that turns the image, images are float32 "
        "throughout, which `shade` and `display` pay."
    ),
}
