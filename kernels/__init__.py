"""Warp kernels of the renderer, one stage a file; installed as `warp_deferred.kernels`."""
