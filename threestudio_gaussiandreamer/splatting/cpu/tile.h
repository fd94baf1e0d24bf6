// Shared by the forward and the backward blend: the splats of a tile in its own coordinates, and which blocks they touch.
#pragma once

#include <bitset>

#include "batch.h"
#include "calls.h"

namespace splat {

struct TileFrame {
  int left, top;
  int begin, end;  // intersections
  bool inside;     // all of its pixels belong to the image

  int last_chunk() const { return begin + (end - begin - 1) / CHUNK * CHUNK; }
};

inline TileFrame frame_of(const View& view, int tile) {
  const int left = tile % view.tiles_x * TILE_WIDTH, top = tile / view.tiles_x * TILE_HEIGHT;
  const bool inside = left + TILE_WIDTH <= view.camera.size.x && top + TILE_HEIGHT <= view.camera.size.y;
  return {left, top, view.tile_begin[tile], view.tile_begin[tile + 1], inside};
}

// y = (a X + b Y + shift_x, c Y + shift_y) at pixel (X, Y) of the tile; log2(alpha) = log2_opacity - |y|^2.
struct alignas(64) LocalSplat {
  float a, b, c, shift_x, shift_y, log2_opacity;
  float red, green, blue, depth, unused[6];
};

// The columns of a Splat, one splat per lane.
struct SplatLanes {
  Floats x, y, a, b, c, log2_opacity, depth, red, green, blue, inverse_a, tilt, slant, extent_x, extent_y, level;
};

// The splats of LANES intersections from `at` on, which may reach into the next tile's; the lists leave those out.
SPLAT_FN SplatLanes load_splats(const View& view, const TileFrame& frame, int at) {
  SplatLanes lanes;
  load_columns<ROW>([&](int l) { return &view.splats[view.intersections[at + l].gaussian].x; }, &lanes.x);
  lanes.x -= float(frame.left), lanes.y -= float(frame.top);
  return lanes;
}

SPLAT_FN void store_local(const SplatLanes& s, LocalSplat* local) {
  const Floats zero = {};
  const Floats shift_x = -(s.a * s.x + s.b * s.y), shift_y = -s.c * s.y;
  Floats columns[ROW] = {s.a,    s.b,     s.c,  shift_x, shift_y, s.log2_opacity, s.red, s.green,
                         s.blue, s.depth, zero, zero,    zero,    zero,           zero,  zero};
  store_columns(columns, &local->a);
}

// Bits [first, end) where the ellipse comes near a pixel centre of a column of blocks, in one row of blocks.
SPLAT_FN Ints blocks_in_row(const Ellipse<Floats>& ellipse, int row) {
  const Floats zero = {}, side = zero + float(BLOCKS_PER_ROW);
  const Floats top = zero + (row * BLOCK_HEIGHT + 0.5f), bottom = top + float(BLOCK_HEIGHT - 1);
  const Span<Floats> x = row_span(ellipse, top, bottom);
  const Ints first = __builtin_convertvector(clamp((x.low + 0.499f) * (1.0f / BLOCK_WIDTH), zero, side), Ints);
  const Ints end = __builtin_convertvector(clamp((x.high + (BLOCK_WIDTH - 0.499f)) * (1.0f / BLOCK_WIDTH), zero, side), Ints);
  const Ints one = Ints{} + 1;
  return meets_rows(ellipse, top - 1e-3f, bottom + 1e-3f) & ((one << end) - 1) & ~((one << first) - 1);
}

constexpr int MASK_WORDS = BLOCKS / 32;
static_assert(BLOCKS_PER_ROW == 8 && BLOCKS % 32 == 0, "a word of the masks has four rows of eight blocks");

// Bit 8 r + c is set when the splat touches block (r, c) of the tile; a word has four rows.
SPLAT_FN void block_masks(const SplatLanes& s, Ints words[MASK_WORDS]) {
  const Ellipse<Floats> ellipse = {s.x, s.y, s.extent_y, s.c * s.c, s.level, s.inverse_a, s.tilt, s.slant};
  std::fill(words, words + MASK_WORDS, Ints{});
#pragma GCC unroll 8  // the shifts become constants
  for (int row = 0; row < BLOCK_ROWS; row++) words[row / 4] |= blocks_in_row(ellipse, row) << (8 * (row % 4));
}

// The staged splats of a chunk and which blocks each of them touches.
struct Staged {
  alignas(64) LocalSplat splats[CHUNK + 1];          // the last one is invisible
  alignas(64) uint32_t touching[MASK_WORDS][CHUNK];  // a bit per block; zero behind the last splat, up to a whole vector
  int count;
  // The splats that touch the row `row` of blocks (-1: none is listed yet): their number, their positions, and a bit per block,
  // which is zero up to a whole vector.
  int row, in_row;
  alignas(64) uint32_t row_positions[CHUNK + LANES], row_touching[CHUNK + LANES];
};

// The splats of one block, see ChunkLists; has room for whole vectors behind the last one.
using BlockList = uint16_t[CHUNK + LANES];

template <class Row> SPLAT_FN Row& row_at(Row* rows, uint16_t position) {
  static_assert(sizeof(Row) == sizeof(float) * ROW, "a row");
  return *reinterpret_cast<Row*>(reinterpret_cast<uintptr_t>(rows) + sizeof(float) * position);
}

// Lists the splats that touch a row of blocks, so that the list of each of its blocks is a choice of those.
SPLAT_FN void list_row(Staged& staged, int row) {
  const uint32_t* words = staged.touching[row / 4];
  Ints positions = lane_numbers() * ROW;
  int count = 0;
  for (int i = 0; i < staged.count; i += LANES, positions += LANES * ROW) {
    const Ints blocks = load_ints(words + i);
    const Choice touching = with_any_bit(blocks, 0xffu << 8 * (row % 4));
    store_ints(staged.row_positions + count, to_front(touching, positions));
    store_ints(staged.row_touching + count, to_front(touching, blocks));
    count += touching.count();
  }
  store_ints(staged.row_touching + count, Ints{});
  staged.row = row, staged.in_row = count;
}

// Writes the splats that touch a block; returns how many.
SPLAT_FN int list_block(Staged& staged, int block, uint16_t* list) {
  if (staged.row != block / BLOCKS_PER_ROW) list_row(staged, block / BLOCKS_PER_ROW);
  int count = 0;
  for (int i = 0; i < staged.in_row; i += LANES) {
    const Choice touching = with_bit(load_ints(staged.row_touching + i), block % 32);
    store_halves(list + count, to_front(touching, load_ints(staged.row_positions + i)));
    count += touching.count();
  }
  return count;
}

inline int whole_batches(int length) { return (length + BATCH - 1) / BATCH * BATCH; }
inline int whole_vectors(int length) { return (length + LANES - 1) / LANES * LANES; }

// Transforms `count` splats to the coordinates of a tile, and finds the blocks that they touch.
SPLAT_FN void stage(const View& view, const TileFrame& frame, int first, int count, bool find_blocks, Staged& staged) {
  for (int i = 0; i < count; i += LANES) {
    for (int l = 0; l < LANES; l++) __builtin_prefetch(&view.splats[view.intersections[first + i + l + PREFETCH].gaussian]);
    const SplatLanes splats = load_splats(view, frame, first + i);
    store_local(splats, staged.splats + i);
    if (!find_blocks) continue;
    Ints words[MASK_WORDS];
    block_masks(splats, words);
    for (int w = 0; w < MASK_WORDS; w++) std::memcpy(staged.touching[w] + i, &words[w], sizeof words[w]);
  }
  staged.splats[CHUNK] = LocalSplat(), staged.splats[CHUNK].log2_opacity = -1e30f;
  if (!find_blocks) return;
  staged.count = count, staged.row = -1;
  for (uint32_t* words : staged.touching) std::fill(words + count, words + whole_vectors(count), 0);
}

// The pixel centres of a block in tile coordinates.
struct BlockPixels {
  int first;  // in the planes
  float left, top;
  Floats x, y;
};

SPLAT_FN BlockPixels block_pixels(int block) {
  Floats column, row;
  for (int l = 0; l < LANES; l++) column[l] = float(l % BLOCK_WIDTH), row[l] = float(l / BLOCK_WIDTH);
  const float left = (block % BLOCKS_PER_ROW) * BLOCK_WIDTH + 0.5f, top = (block / BLOCKS_PER_ROW) * BLOCK_HEIGHT + 0.5f;
  return {block * LANES, left, top, column + left, row + top};
}

// The splats of a batch: those of `list` from `first` on.
struct BatchSplats {
  const Staged& staged;
  const uint16_t* list;

  const LocalSplat& operator[](int k) const { return row_at(staged.splats, list[k]); }
};

// log2(alpha) of the splats of a batch at the pixels of a block, before cap and threshold.
template <int N> SPLAT_FN Batch<N> power_at(const BatchSplats& s, const BlockPixels& pixels) {
  Batch<N> y1 = each<N>([&](int k) { return s[k].b * pixels.y + s[k].shift_x; });
  const Batch<N> y2 = each<N>([&](int k) { return s[k].c * pixels.y + s[k].shift_y; });
  y1 = each<N>([&](int k) { return s[k].a * pixels.x + y1.of[k]; });
  const Batch<N> power = each<N>([&](int k) { return s[k].log2_opacity - y1.of[k] * y1.of[k]; });
  return power - y2 * y2;
}

// Transmittance 1 for pixels of the image, 0 for those of the tile that lie outside of it: they have stopped already.
inline void start_transmittance(const View& view, const TileFrame& frame, float* transmittance) {
  if (frame.inside) return (void)std::fill(transmittance, transmittance + TILE_PIXELS, 1.0f);
  for (int block = 0; block < BLOCKS; block++)
    for (int p = 0; p < LANES; p++) {
      const int x = frame.left + block % BLOCKS_PER_ROW * BLOCK_WIDTH + p % BLOCK_WIDTH;
      const int y = frame.top + block / BLOCKS_PER_ROW * BLOCK_HEIGHT + p / BLOCK_WIDTH;
      transmittance[block * LANES + p] = x < view.camera.size.x && y < view.camera.size.y ? 1.0f : 0.0f;
    }
}

// Which blocks still have pixels that haven't stopped.
using LiveBlocks = std::bitset<BLOCKS>;

// Writes the splats that touch a block, filled up to whole vectors with the invisible one, since the backward pass reads whole
// vectors; returns how many touch it.
SPLAT_FN int list_filled(Staged& staged, int block, uint16_t* list) {
  const int length = list_block(staged, block, list);
  store_halves(list + length, Ints{} + CHUNK * ROW);
  return length;
}

// Whether the lists of all blocks are short enough to be kept; if so, there is room for them.
inline bool can_keep(const Staged& staged, ChunkLists& lists) {
  int64_t pairs = 0;
  for (const uint32_t* words : staged.touching)
    for (int i = 0; i < staged.count; i++) pairs += __builtin_popcount(words[i]);
  if (pairs <= KEPT_PAIRS * CHUNK) lists.splats.reserve(pairs + BLOCKS * LANES);
  return pairs <= KEPT_PAIRS * CHUNK;
}

// Calls blend(pixels, list, length) for each live block and the splats that touch it; it returns how many it needed, or 0 if
// the block continues behind all of them. Keeps the lists unless `lists` is null.
template <class Blend> SPLAT_FN void for_each_live_block(Staged& staged, LiveBlocks& live, ChunkLists* lists, Blend blend) {
  BlockList list;
  uint16_t* keep = nullptr;
  if (lists && (lists->kept = can_keep(staged, *lists))) keep = lists->splats.data();
  for (int block = 0; block < BLOCKS; block++) {
    int length = live[block] ? list_filled(staged, block, list) : 0;
    if (const int needed = length ? blend(block_pixels(block), list, length) : 0) length = needed, live.reset(block);
    if (lists) lists->lengths[block] = uint16_t(length);
    if (keep) keep = std::copy(list, list + whole_vectors(length), keep);
  }
}

// Calls blend(pixels, list, length) again for the same blocks and splats.
template <class Blend> SPLAT_FN void for_each_listed_block(Staged& staged, const ChunkLists& lists, Blend blend) {
  BlockList list;
  const uint16_t* kept = lists.splats.data();
  for (int block = 0; block < BLOCKS; block++) {
    int length = lists.lengths[block];
    if (!length) continue;
    if (!lists.kept) length = std::min(length, list_filled(staged, block, list));
    blend(block_pixels(block), lists.kept ? kept : list, length);
    if (lists.kept) kept += whole_vectors(length);
  }
}

}  // namespace splat
