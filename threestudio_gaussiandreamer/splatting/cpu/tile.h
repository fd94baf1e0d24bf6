// Shared by the forward and the backward blend: the splats of a tile in its own coordinates, and which blocks they touch.
#pragma once

#include "calls.h"

namespace splat {

constexpr int CHUNK = 512;      // splats staged at a time
constexpr int PREFETCH = 32;    // splats ahead
constexpr int CHECK_EVERY = 4;  // splats between two tests whether all pixels of a strip have stopped

struct TileFrame {
  int left, top;
  int begin, end;  // intersections
  bool inside;     // all of its pixels belong to the image
};

inline TileFrame frame_of(const View& view, int tile) {
  const int left = tile % view.tiles_x * TILE, top = tile / view.tiles_x * TILE;
  const bool inside = left + TILE <= view.camera.size.x && top + TILE <= view.camera.size.y;
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

SPLAT_FN SplatLanes load_splats(const View& view, const TileFrame& frame, int at, int count) {
  SplatLanes lanes;
  load_columns<ROW>([&](int l) { return &view.splats[view.intersections[at + std::min(l, count - 1)].gaussian].x; }, &lanes.x);
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
  const Floats zero = {}, top = zero + (row * BLOCK + 0.5f), bottom = top + float(BLOCK - 1), side = zero + float(BLOCKS_PER_ROW);
  const Span<Floats> x = row_span(ellipse, top, bottom);
  const Ints first = __builtin_convertvector(clamp((x.low + 0.499f) * (1.0f / BLOCK), zero, side), Ints);
  const Ints end = __builtin_convertvector(clamp((x.high + (BLOCK - 0.499f)) * (1.0f / BLOCK), zero, side), Ints);
  const Ints one = Ints{} + 1;
  return meets_rows(ellipse, top - 1e-3f, bottom + 1e-3f) & ((one << end) - 1) & ~((one << first) - 1);
}

// Bit 8 r + c is set when the splat touches block (r, c) of the tile; rows 0 to 3 are the first half.
SPLAT_FN void block_masks(const SplatLanes& s, Ints halves[2]) {
  const Ellipse<Floats> ellipse = {s.x, s.y, s.extent_y, s.c * s.c, s.level, s.inverse_a, s.tilt, s.slant};
  halves[0] = halves[1] = Ints{};
  for (int row = 0; row < BLOCKS_PER_ROW; row++) halves[row / 4] |= blocks_in_row(ellipse, row) << (8 * (row % 4));
}

// The staged splats of a chunk and which blocks each of them touches.
struct Staged {
  alignas(64) LocalSplat splats[CHUNK];
  alignas(64) uint32_t touching[2][CHUNK];  // halves of the masks; zero behind the last splat, up to a whole group
  int groups;                               // of 64 splats
#if !defined(__AVX512F__)
  uint64_t splats_of[CHUNK];  // [64 splats][block], one bit per splat
#endif
};

// Where the splats of a block are among the staged ones, front to back: the first float of each row of ROW floats.
using BlockList = uint32_t[CHUNK + 16];

template <class Row> SPLAT_FN Row& row_at(Row* rows, uint32_t position) {
  static_assert(sizeof(Row) == sizeof(float) * ROW, "a row");
  return *reinterpret_cast<Row*>(reinterpret_cast<uintptr_t>(rows) + sizeof(float) * position);
}

#if defined(__AVX512F__)
SPLAT_FN void list_splats(Staged&) {}

// Writes the splats that touch a block; returns how many.
SPLAT_FN int list_block(const Staged& staged, int block, BlockList& list) {
  const __m512i bit = _mm512_set1_epi32(int(1u << block % 32)), step = _mm512_set1_epi32(16 * ROW);
  __m512i positions = _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
  positions = _mm512_mullo_epi32(positions, _mm512_set1_epi32(ROW));
  int count = 0;
  for (int i = 0; i < staged.groups * 64; i += 16) {
    const __mmask16 touching = _mm512_test_epi32_mask(_mm512_load_si512(staged.touching[block / 32] + i), bit);
    _mm512_storeu_si512(list + count, _mm512_maskz_compress_epi32(touching, positions));
    count += __builtin_popcount(touching);
    positions = _mm512_add_epi32(positions, step);
  }
  return count;
}
#else
// Transposes 64 x 64 bits: bit i of word j becomes bit j of word i (Warren, Hacker's Delight, 7-3).
inline void transpose_bits(uint64_t* words) {
  uint64_t mask = 0x00000000ffffffff;
  for (int step = 32; step; step >>= 1, mask ^= mask << step)
    for (int i = 0; i < 64; i += 2 * step)
      for (int j = i; j < i + step; j++) {
        const uint64_t swap = (words[j] >> step ^ words[j + step]) & mask;
        words[j] ^= swap << step, words[j + step] ^= swap;
      }
}

// From the blocks of each splat to the splats of each block.
inline void list_splats(Staged& staged) {
  for (int i = 0; i < staged.groups * 64; i++)
    staged.splats_of[i] = uint64_t(staged.touching[1][i]) << 32 | staged.touching[0][i];
  for (int group = 0; group < staged.groups; group++) transpose_bits(staged.splats_of + group * 64);
}

// The positions of the bits of each byte, low to high.
struct BitPositions {
  uint8_t of[256][8] = {};
  uint8_t count[256] = {};
  constexpr BitPositions() {
    for (int byte = 0; byte < 256; byte++)
      for (int bit = 0; bit < 8; bit++)
        if (byte >> bit & 1) of[byte][count[byte]++] = uint8_t(bit);
  }
};
constexpr BitPositions BIT_POSITIONS;

// Writes the splats that touch a block; returns how many.
SPLAT_FN int list_block(const Staged& staged, int block, BlockList& list) {
  typedef uint8_t Bytes __attribute__((vector_size(8)));
  typedef uint32_t Words __attribute__((vector_size(32)));
  int count = 0;
  for (int group = 0; group < staged.groups; group++)
    for (uint64_t word = staged.splats_of[group * 64 + block], first = group * 64; word; word >>= 8, first += 8) {
      Bytes positions;
      std::memcpy(&positions, BIT_POSITIONS.of[word & 255], sizeof positions);
      const Words splats = (__builtin_convertvector(positions, Words) + uint32_t(first)) * ROW;
      std::memcpy(list + count, &splats, sizeof splats);
      count += BIT_POSITIONS.count[word & 255];
    }
  return count;
}
#endif

// Transforms `count` splats to the coordinates of a tile; the masks of the blocks that they overlap are computed, or read from
// `masks` (2, count), which may be null when they are computed.
template <bool FIND>
SPLAT_FN void stage(const View& view, const TileFrame& frame, int first, int count, uint32_t* masks, Staged& staged) {
  for (int i = 0; i < count; i += LANES) {
    for (int l = 0; l < LANES; l++)
      __builtin_prefetch(&view.splats[view.intersections[std::min(first + i + l + PREFETCH, frame.end - 1)].gaussian]);
    const SplatLanes splats = load_splats(view, frame, first + i, count - i);
    store_local(splats, staged.splats + i);
    if (!FIND) continue;
    Ints halves[2];
    block_masks(splats, halves);
    for (int half = 0; half < 2; half++) std::memcpy(staged.touching[half] + i, &halves[half], sizeof halves[half]);
  }
  staged.groups = (count + 63) / 64;
  for (int half = 0; half < 2; half++) {
    if (FIND && masks) std::memcpy(masks + half * count, staged.touching[half], sizeof(uint32_t) * count);
    if (!FIND) std::memcpy(staged.touching[half], masks + half * count, sizeof(uint32_t) * count);
    std::fill(staged.touching[half] + count, staged.touching[half] + staged.groups * 64, 0);
  }
  list_splats(staged);
}

// The pixel centres of a strip in tile coordinates.
struct StripPixels {
  int first;  // in the planes
  float left, top;
  Floats x, y;
};

SPLAT_FN StripPixels strip_pixels(int block, int strip) {
  Floats column, row;
  for (int l = 0; l < LANES; l++) column[l] = float(l % BLOCK), row[l] = float(l / BLOCK);
  const float left = (block % BLOCKS_PER_ROW) * BLOCK + 0.5f;
  const float top = (block / BLOCKS_PER_ROW) * BLOCK + strip * (LANES / BLOCK) + 0.5f;
  return {block * BLOCK_PIXELS + strip * LANES, left, top, column + left, row + top};
}

// y of a splat at the pixels of a strip, and its log2(alpha) there before cap and threshold.
SPLAT_FN Floats power_at(const LocalSplat& s, const StripPixels& pixels, Floats& y1, Floats& y2) {
  y1 = s.a * pixels.x + (s.b * pixels.y + s.shift_x);
  y2 = s.c * pixels.y + s.shift_y;
  return (s.log2_opacity - y1 * y1) - y2 * y2;
}

// Transmittance 1 for pixels of the image, 0 for those of the tile that lie outside of it: they have stopped already.
inline void start_transmittance(const View& view, const TileFrame& frame, float* transmittance) {
  if (frame.inside) return (void)std::fill(transmittance, transmittance + TILE_PIXELS, 1.0f);
  for (int block = 0; block < BLOCKS; block++)
    for (int p = 0; p < BLOCK_PIXELS; p++) {
      const int x = frame.left + block % BLOCKS_PER_ROW * BLOCK + p % BLOCK;
      const int y = frame.top + block / BLOCKS_PER_ROW * BLOCK + p / BLOCK;
      transmittance[block * BLOCK_PIXELS + p] = x < view.camera.size.x && y < view.camera.size.y ? 1.0f : 0.0f;
    }
}

// Which strips still have pixels that haven't stopped: a bit per block for each strip.
struct LiveStrips {
  uint64_t blocks[STRIPS];

  LiveStrips() { std::fill(blocks, blocks + STRIPS, ~uint64_t(0)); }
  bool any() const {
    return std::any_of(blocks, blocks + STRIPS, [](uint64_t b) { return b != 0; });
  }
};

// Calls blend(pixels, list, length), which returns whether the strip continues, for each unfinished strip and the splats that
// overlap it.
template <class Blend> SPLAT_FN void for_each_live_strip(const Staged& staged, LiveStrips& live, Blend blend) {
  BlockList list;
  for (int block = 0; block < BLOCKS; block++) {
    uint64_t alive = 0;
    for (int strip = 0; strip < STRIPS; strip++) alive |= live.blocks[strip] >> block & 1;
    const int length = alive ? list_block(staged, block, list) : 0;
    for (int strip = 0; length && strip < STRIPS; strip++)
      if (live.blocks[strip] >> block & 1 && !blend(strip_pixels(block, strip), list, length))
        live.blocks[strip] &= ~(uint64_t(1) << block);
  }
}

}  // namespace splat
