// Data of one view between the stages, and between a forward pass and its backward pass.
#pragma once

#include <algorithm>
#include <deque>
#include <vector>

#include "buffer.h"
#include "lanes.h"
#include "scene.h"
#include "splat_math.h"

namespace splat {

// Pixels. Every splat of a tile is tested against all of its rows of blocks. In lower tiles these are fewer, but more splats are
// in several tiles: with 8 lanes the first counts more, with 16 neither.
constexpr int TILE_WIDTH = 32, TILE_HEIGHT = LANES == 16 ? 32 : 16, TILE_PIXELS = TILE_WIDTH * TILE_HEIGHT;
// A block has as many pixels as there are lanes: 4 columns, and 4, 2 or 1 rows.
constexpr int BLOCK_WIDTH = 4, BLOCK_HEIGHT = LANES / BLOCK_WIDTH;
constexpr int BLOCKS_PER_ROW = TILE_WIDTH / BLOCK_WIDTH, BLOCK_ROWS = TILE_HEIGHT / BLOCK_HEIGHT;
constexpr int BLOCKS = BLOCKS_PER_ROW * BLOCK_ROWS;
constexpr int CHUNK = 512;    // splats of a tile that are blended at a time
constexpr int PREFETCH = 32;  // splats ahead

constexpr int SLICE = 2048;  // Gaussians projected by one task

// Rows or columns of tiles, [begin, end), both below 2^16: validation.py limits the size of images.
struct TileSpan {
  uint32_t bits;  // end << 16 | begin

  int begin() const { return bits & 0xffff; }
  int end() const { return bits >> 16; }
  int size() const { return end() - begin(); }
};

inline TileSpan tile_span(int begin, int end) { return {uint32_t(end) << 16 | uint32_t(begin)}; }

// The tiles of one Gaussian: in each of its rows `columns`, or where `span` isn't negative, only the spans of the slice from
// there on. Every pair of Gaussian and tile has a slot, where the backward pass puts its gradient; those of a Gaussian follow
// one another, up to the first one of the next Gaussian.
struct Coverage {
  int32_t slot;  // the first one, counted within the slice
  int32_t span;
  TileSpan rows, columns;

  // Whether 1 to 2 x 2 tiles.
  bool tiny() const { return uint32_t(rows.size() - 1) < 2 && uint32_t(columns.size() - 1) < 2; }
};

// SLICE consecutive Gaussians.
struct Slice {
  std::vector<TileSpan> spans;
  int64_t slots;
  int32_t visible, first_slot;
};

// A Gaussian in a tile.
struct Intersection {
  int32_t gaussian, slot;
};

constexpr int KEPT_PAIRS = BLOCKS / 2;  // of splats and blocks, per splat of a chunk; the lists of chunks with more aren't kept

// The splats of a chunk that are blended into each block: block after block, front to back, each list filled up to whole
// vectors. A splat is the position of its first float among the chunk's, each of which has ROW floats.
struct ChunkLists {
  uint16_t lengths[BLOCKS];
  bool kept;  // else there are the lengths only
  Buffer<uint16_t> splats;
  Buffer<float> transmittance;  // (TILE_PIXELS) before the chunk; not set in a tile's first one

  bool empty() const {
    return std::all_of(lengths, lengths + BLOCKS, [](uint16_t length) { return length == 0; });
  }
};

// Sums of weight * (colour, depth, 1) per pixel of a tile, block after block. 1 - alpha is the weight of the background.
struct Planes {
  alignas(64) float red[TILE_PIXELS], green[TILE_PIXELS], blue[TILE_PIXELS], depth[TILE_PIXELS], alpha[TILE_PIXELS];
};

struct View {
  int index, tiles_x, tiles_y;
  int64_t intersection_count;
  Camera camera;
  Buffer<Splat> splats;        // (N)
  Buffer<Coverage> coverages;  // (N), and one more behind each slice
  std::vector<Slice> slices;
  Buffer<uint64_t> keys, spare_keys;  // depth << 32 | Gaussian
  Buffer<int32_t> histogram;  // of the intersections: corners() numbers per part of the Gaussians, see sum_corners
  bool counted;               // by the projection, as one part
  Buffer<int32_t> tile_begin;    // (tiles + 1) into intersections
  Buffer<Intersection> intersections;  // by tile, then by depth; behind them zeros, as many as are read ahead
  std::deque<ChunkLists> lists;        // never shrinks
  Buffer<float> peaks;                 // per slot, the largest weight of the Gaussian in the tile

  // Allocates everything whose size doesn't depend on the positions of the Gaussians.
  void prepare(const Scene& scene, int view) {
    index = view, tiles_x = (scene.width + TILE_WIDTH - 1) / TILE_WIDTH, tiles_y = (scene.height + TILE_HEIGHT - 1) / TILE_HEIGHT;
    slices.resize((scene.gaussians + SLICE - 1) / SLICE);
    const size_t padded = slices.size() * SLICE;
    splats.reserve(padded), keys.reserve(padded), spare_keys.reserve(padded), coverages.reserve(padded + slices.size());
  }

  int tiles() const { return tiles_x * tiles_y; }
  int corners() const { return (tiles_x + 1) * (tiles_y + 1); }
  // The lists of the chunk of a tile that begins at an intersection.
  ChunkLists& lists_of(int tile, int first) { return lists[first / CHUNK + tile]; }
  const ChunkLists& lists_of(int tile, int first) const { return lists[first / CHUNK + tile]; }
  const Slice& slice_of(int64_t gaussian) const { return slices[gaussian / SLICE]; }
  Coverage& coverage(int64_t gaussian) { return coverages[gaussian + gaussian / SLICE]; }
  const Coverage& coverage(int64_t gaussian) const { return coverages[gaussian + gaussian / SLICE]; }
  int64_t slot_begin(int64_t gaussian) const { return slice_of(gaussian).first_slot + coverage(gaussian).slot; }
  int64_t slot_end(int64_t gaussian) const { return slice_of(gaussian).first_slot + (&coverage(gaussian))[1].slot; }
};

// Calls visit(rows, columns) for rectangles of tiles that together are those of a Gaussian, in the order of its slots.
template <class Visit> SPLAT_FN void for_each_rectangle(const View& view, int64_t gaussian, Visit visit) {
  const Coverage& c = view.coverage(gaussian);
  if (c.span < 0) return visit(c.rows, c.columns);
  const TileSpan* spans = view.slice_of(gaussian).spans.data() + c.span;
  for (int y = c.rows.begin(); y < c.rows.end(); y++) visit(tile_span(y, y + 1), *spans++);
}

// Counts a Gaussian's tiles at the corners of its rectangles, which takes as long for many tiles as for one. The count of a tile
// is at most the number of Gaussians, even in scenes with too many intersections to be numbered.
SPLAT_FN void add_corners(const View& view, int64_t gaussian, int32_t* corners) {
  for_each_rectangle(view, gaussian, [&](TileSpan rows, TileSpan columns) {
    int32_t* top = corners + rows.begin() * (view.tiles_x + 1);
    int32_t* bottom = corners + rows.end() * (view.tiles_x + 1);
    top[columns.begin()]++, top[columns.end()]--, bottom[columns.begin()]--, bottom[columns.end()]++;
  });
}

// From the corners() numbers of add_corners to the number of Gaussians in each tile, in the first tiles() of them.
inline void sum_corners(const View& view, int32_t* corners) {
  const int32_t* next = corners;
  int32_t* count = corners;
  for (int y = 0; y < view.tiles_y; y++, next++) {
    int32_t row = 0;
    for (int x = 0; x < view.tiles_x; x++, count++) {
      row += *next++;
      *count = row + (y ? count[-view.tiles_x] : 0);
    }
  }
}

// Never shrinks, so that the views' buffers are reused; the scene has their number.
using Views = std::deque<View>;

}  // namespace splat
