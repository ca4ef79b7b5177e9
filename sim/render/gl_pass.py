"""The one pass of the graphics pipeline that makes a picture: programs, textures and target."""

from __future__ import annotations

from importlib import resources
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from visctrl.hal.errors import InputError
from visctrl.sim.render.gl_context import open_context
from visctrl.sim.render.raycast import Candidates, Tiles
from visctrl.sim.render.texture_sheet import TextureSheet
from visctrl.sim.render.textures import OBLIQUENESS

if TYPE_CHECKING:
    import moderngl

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Single = NDArray[np.float32]
Whole = NDArray[np.int32]

#: Entries in a row of the textures that hold tables: powers of two.
_HITS_ROW, _PLACES_ROW, _TILES_ROW = 256, 1024, 16
#: Numbers of candidates for which there are programs of their own; 0 is for any number.
_COUNTS = (1, 2, 3, 4, 0)
#: Side of the blocks of pixels whose rays lie together (px).
_BLOCK = 4
#: Texels of a candidate.
_HIT = 3


class RayPass:
    """Follows the ray of every pixel to the nearest of its tile's candidates.

    Parameters
    ----------
    rays : (H, W, 4)
        Unit rays in camera axes, and the angle (rad) that the pixel spans: 0 where it is black.
    tiles : Tiles
        The parts of the image that are drawn; their side is a multiple of 4 px.
    sheet : TextureSheet
        The textures.

    Raises
    ------
    InputError
        See `open_context`; or the scene has more texture than the driver can hold.
    """

    def __init__(self, rays: Array, tiles: Tiles, sheet: TextureSheet) -> None:
        self._size = rays.shape[:2]
        self._where = np.column_stack([tiles.corner, np.arange(len(tiles.corner))])
        self._context: moderngl.Context | None = open_context()
        try:
            with self._context:
                self._load(self._context, _by_blocks(tiles.gather(rays)), tiles.side, sheet)
        except BaseException:
            self.close()
            raise

    def draw(self, candidates: Candidates, hits: Single) -> Image:
        """Return the picture (H, W).

        Parameters
        ----------
        candidates : Candidates
            Of each tile.
        hits : (N, 3, 4) float32
            What they are, tile by tile: rows of the map, and beside these the eye's distance
            from the plane (m), the texels per metre of the texture, its number in the sheet.
        """
        if self._context is None:
            raise RuntimeError("the renderer is closed")
        ends = np.cumsum(candidates.counts)
        tiles = np.column_stack([self._where, ends - candidates.counts, ends]).astype(np.int32)
        # A single one that does not fill its tile has nothing behind it, and must be tested too.
        program = np.where(candidates.filled | (candidates.counts != 1), candidates.counts, 0)
        program[program > max(_COUNTS)] = 0
        picture = np.empty(self._size, np.uint8)
        with self._context:
            # What no tile covers, or a tile that shows nothing, stays black.
            self._target.clear()
            self._write_hits(self._context, hits)
            for count, drawn in zip(_COUNTS, self._programs, strict=True):
                drawn.draw(tiles[(program == count) & (candidates.counts > 0)])
            self._target.read_into(picture, components=1, alignment=1)
        return picture

    def close(self) -> None:
        """Release the context and everything in it. Safe to call twice."""
        if self._context is not None:
            self._context.release()
            self._context = None

    def _load(
        self, context: moderngl.Context, rays: Single, side: int, sheet: TextureSheet
    ) -> None:
        height, width = self._size
        table = _in_rows(rays, _TILES_ROW)
        _check_sizes(context, [self._size, table.shape[:2], sheet.levels[0].shape])
        places = _in_rows(np.array(sheet.places, np.float32)[:, None], _PLACES_ROW)
        self._hits = _floats(context, np.zeros((1, _HIT * _HITS_ROW, 4), np.float32))
        textures = {
            "hits": self._hits,
            "places": _floats(context, places),
            "rays": _floats(context, table),
            "sheet": _mipmapped(context, sheet.levels),
        }
        for unit, texture in enumerate(textures.values()):
            texture.use(unit)
        uniforms = {
            "image_size": (width, height),
            **{name: unit for unit, name in enumerate(textures)},
        }
        self._programs = [
            _TileProgram(context, count, side, uniforms, len(rays)) for count in _COUNTS
        ]
        self._target = context.framebuffer([context.renderbuffer((width, height), 1)])
        self._target.use()

    def _write_hits(self, context: moderngl.Context, hits: Single) -> None:
        table = _in_rows(hits, _HITS_ROW)
        rows = len(table)
        if rows > self._hits.height:
            self._hits.release()
            self._hits = _floats(context, np.zeros((2 * rows, *table.shape[1:]), np.float32))
            self._hits.use(0)
        self._hits.write(table, viewport=(0, 0, _HIT * _HITS_ROW, rows))


class _TileProgram:
    """Draws tiles.

    count : of each tile's candidates; 1 is one that fills the tile, 0 is any number.
    side : of the tiles (px).
    most : how many there may be.
    """

    def __init__(
        self,
        context: moderngl.Context,
        count: int,
        side: int,
        uniforms: dict[str, object],
        most: int,
    ) -> None:
        tables = _source("tables.glsl")
        defines = {
            "COUNT": count,
            "TILE": side,
            "TILES_ROW": _TILES_ROW,
            "HITS_ROW": _HITS_ROW,
            "PLACES_ROW": _PLACES_ROW,
            "OBLIQUENESS": OBLIQUENESS,
        }
        lines = "".join(f"#define {name} {value}\n" for name, value in defines.items())
        head = tables.replace("#version 330\n", f"#version 330\n{lines}")
        program = context.program(head + _source("tile.vert"), head + _source("ray.frag"))
        for name, value in uniforms.items():
            program[name] = value
        self._mode = context.TRIANGLE_STRIP
        self._buffer = context.buffer(reserve=20 * most)
        self._vertices = context.vertex_array(
            program, [(self._buffer, "3i 2i/i", "tile", "candidates")]
        )

    def draw(self, tiles: Whole) -> None:
        """Draw tiles (N, 5): column, row, number, first candidate and the one after the last."""
        if len(tiles):
            self._buffer.write(np.ascontiguousarray(tiles))
            self._vertices.render(self._mode, vertices=4, instances=len(tiles))


def _check_sizes(context: moderngl.Context, sizes: list[tuple[int, ...]]) -> None:
    """Refuse textures (rows, columns) that the driver does not allow."""
    most = _most_texels(context)
    for rows, columns in sizes:
        if max(rows, columns) > most:
            raise InputError(
                f"renderer 'gl' needs a texture of {columns}x{rows}, this OpenGL driver allows "
                f"{most}x{most}: use a smaller scene or image, or renderer 'tiny'"
            )


def _most_texels(context: moderngl.Context) -> int:
    """Return the largest side of a texture."""
    return int(context.info["GL_MAX_TEXTURE_SIZE"])


def _source(name: str) -> str:
    return (resources.files("visctrl.sim.render") / "shaders" / name).read_text(encoding="utf-8")


def _by_blocks(rays: Array) -> Single:
    """Arrange the rays of tiles (T, side, side, 4), block by block: (T, side², 4)."""
    count, side = rays.shape[:2]
    blocks = rays.reshape(count, side // _BLOCK, _BLOCK, side // _BLOCK, _BLOCK, 4).swapaxes(2, 3)
    return blocks.reshape(count, side * side, 4).astype(np.float32)


def _in_rows(entries: Single, length: int) -> Single:
    """Arrange entries (N, K, 4) in rows of ``length``: (rows, length K, 4), the rest zero."""
    rows = -(-len(entries) // length)
    table = np.zeros((rows * length, *entries.shape[1:]), np.float32)
    table[: len(entries)] = entries
    return table.reshape(rows, -1, 4)


def _floats(context: moderngl.Context, values: Single) -> moderngl.Texture:
    """Return a texture of (H, W, 4) numbers that are read one by one."""
    height, width, _ = values.shape
    texture = context.texture((width, height), 4, np.ascontiguousarray(values), dtype="f4")
    texture.filter = (context.NEAREST, context.NEAREST)
    return texture


def _mipmapped(context: moderngl.Context, levels: list[Image]) -> moderngl.Texture:
    rows, columns = levels[0].shape
    texture = context.texture((columns, rows), 1, levels[0])
    # Makes room for the levels; what is in them is ours.
    texture.build_mipmaps(max_level=len(levels) - 1)
    for k, level in enumerate(levels[1:], 1):
        texture.write(level, level=k)
    texture.filter = (context.LINEAR_MIPMAP_LINEAR, context.LINEAR)
    texture.repeat_x = texture.repeat_y = False
    return texture
