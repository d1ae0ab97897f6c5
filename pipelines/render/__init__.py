"""New video from a finished run and its clip: stabilised, with an inlay, or a new camera over the panorama.

`views` (cameras and warps between them), `opened` (a run, its clip and its panoramas), `plate` (the panorama as a
camera sees it), `matte` (who stands in front), `inlay` (the picture that is put in), `paths` (smoothed and keyframed
cameras), `encode` (video and sound out), `job` (what the jobs share), and the jobs: `stabilise`, `overlay`, `move`.
"""
