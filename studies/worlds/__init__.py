"""Pictures, labels and distances of the worlds of a game, Freedoom, through any lens.

`wad` reads maps, `geometry` turns them into surfaces, and `textures` and `things` hold their
pictures. `scene` casts rays, `poses` finds poses, `render` renders a pose through a lens, and
`dataset` writes the results. Freedoom's textures are drawn by hand and under the BSD licence
(https://freedoom.github.io).
"""
