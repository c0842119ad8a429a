"""Sparse models: poses and points of verified matches, by pycolmap, and what contradicts them.

The files, in the order in which they first run. All run when poses are estimated. Those marked *
run also when poses are given; ``adjustment`` and ``intrinsics`` then only to refine something.

- ``model`` *: photos go in, a sparse model comes out; thresholds, and points that miss them.
- ``triangulation`` *: leads. ``reconstruct`` estimates poses, ``triangulate`` keeps given ones.
- ``look_alikes``: drops pairs of photos that lack the matches that they should have.
- ``thinning``: keeps enough keypoints to find poses.
- ``colmap_scene`` *: photos, rigs and matches into a COLMAP database, and the model out of it.
- ``colmap_calls`` *: calls of pycolmap that can be interrupted, and print errors only.
- ``incremental``: finds poses, photo after photo, and keeps the largest model.
- ``adjustment`` *: bundle adjustment, while a model grows and when it is finished.
- ``intrinsics`` *: judges refined cameras; those not believed keep what was known of them.
- ``points`` *: makes points of all matches with the poses that were found.
- ``contradictions``: finds two places in a finished model; ``mapping.methods.undoing`` then drops
  the pairs that join them, and begins again.
- ``latecomers``: finds places in the finished model for photos that it left out.
- ``extending``: calls ``latecomers``, and adds these photos to the model.
- ``pair_agreement``: finds pairs that contradict the finished poses, and makes a doubt of them.
"""
