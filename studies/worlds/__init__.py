"""Pictures, labels and distances of the worlds of a game, Freedoom, through any lens.

`wad` reads maps, `geometry` makes surfaces of them, `textures` and `things` say how they look,
`scene` casts rays, `render` makes pictures of a pose through a lens, `poses` finds poses, `dataset`
writes them. Freedoom's textures are a game's, drawn by hand; they are under the BSD licence
(https://freedoom.github.io).
"""
