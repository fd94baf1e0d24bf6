// What the forward and the backward blend share: the splats of a tile in its own coordinates, and which blocks they touch.
#pragma once

#include "view.h"

namespace splat {

constexpr int CHUNK = 256;     // splats staged at a time
constexpr int PREFETCH = 32;   // splats ahead
constexpr int CHECK_EVERY = 8; // splats between two looks at whether all pixels of a strip have stopped

// y = (a X + b Y + shift_x, c Y + shift_y) at pixel (X, Y) of the tile; log2(alpha) = log2_opacity - |y|^2.
struct alignas(64) LocalSplat {
  float a, b, c, shift_x, shift_y, log2_opacity;
  float red, green, blue, depth;
};

SPLAT_FN LocalSplat to_tile(const Splat& s, float left, float top) {
  const float x = s.x - left, y = s.y - top;
  return {s.a, s.b, s.c, -(s.a * x + s.b * y), -s.c * y, s.log2_opacity, s.red, s.green, s.blue, s.depth};
}

// Bit 8 r + c is set when the ellipse comes near a pixel centre of block (r, c): one lane per row of blocks finds the
// ellipse's columns.
SPLAT_FN uint64_t block_mask(const Splat& splat, float left, float top) {
  const Octet zero = {}, row = {0, 1, 2, 3, 4, 5, 6, 7};
  const Octet y_low = row * float(BLOCK) + (top + 0.5f - splat.y), y_high = y_low + float(BLOCK - 1);
  const Octet nearest = clamp(zero, y_low, y_high);
  const OctetInts meets = nearest * nearest <= zero + (splat.extent_y * splat.extent_y + 1e-3f);
  const Span<Octet> x = row_span(splat, y_low, y_high);
  const float to_block = 1.0f / BLOCK, shift = splat.x - left;
  const Octet first = clamp((x.low + (shift + 0.499f)) * to_block, zero, zero + 8.0f);
  const Octet end = clamp((x.high + (shift - 0.499f)) * to_block + 1.0f, zero, zero + 8.0f);
  const OctetInts one = {1, 1, 1, 1, 1, 1, 1, 1};
  const OctetInts bits = meets & ((one << __builtin_convertvector(end, OctetInts)) - 1) & ~((one << __builtin_convertvector(first, OctetInts)) - 1);
  typedef uint8_t Bytes __attribute__((vector_size(8)));
  const Bytes bytes = __builtin_convertvector(bits, Bytes);
  uint64_t mask;
  std::memcpy(&mask, &bytes, sizeof mask);
  return mask;
}

// For each block the staged splats that touch it, front to back.
struct BlockLists {
  int32_t lengths[BLOCKS];
  uint16_t splats[BLOCKS][CHUNK];

  void clear() { std::memset(lengths, 0, sizeof lengths); }
  void add(uint16_t splat, uint64_t mask) {
    for (; mask; mask &= mask - 1) {
      const int block = __builtin_ctzll(mask);
      splats[block][lengths[block]++] = splat;
    }
  }
};

struct TileFrame {
  int index, left, top;
  int begin, end;  // entries
};

inline TileFrame frame_of(const View& view, int tile) {
  return {tile, tile % view.tiles_x * TILE, tile / view.tiles_x * TILE, view.tile_begin[tile], view.tile_begin[tile + 1]};
}

// Copies `count` splats of a tile into its coordinates; `mask_of(entry, splat)` says which blocks each one touches.
template <class MaskOf> SPLAT_FN void stage(const View& view, const TileFrame& frame, int first, int count, LocalSplat* local, BlockLists& lists, MaskOf mask_of) {
  lists.clear();
  for (int i = 0; i < count; i++) {
    const int entry = first + i;
    __builtin_prefetch(&view.splats[view.entries[std::min(entry + PREFETCH, frame.end - 1)].gaussian]);
    const Splat& splat = view.splats[view.entries[entry].gaussian];
    local[i] = to_tile(splat, float(frame.left), float(frame.top));
    lists.add(uint16_t(i), mask_of(entry, splat));
  }
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
  const float left = (block % BLOCKS_PER_ROW) * BLOCK + 0.5f, top = (block / BLOCKS_PER_ROW) * BLOCK + strip * (LANES / BLOCK) + 0.5f;
  return {block * BLOCK_PIXELS + strip * LANES, left, top, column + left, row + top};
}

// log2(alpha) of a splat at the pixels of a strip, before cap and threshold.
SPLAT_FN Floats power_at(const LocalSplat& s, const StripPixels& pixels, Floats& y1, Floats& y2) {
  y1 = s.a * pixels.x + (s.b * pixels.y + s.shift_x);
  y2 = s.c * pixels.y + s.shift_y;
  return (s.log2_opacity - y1 * y1) - y2 * y2;
}

// Transmittance 1 for pixels of the image, 0 for those of the tile that lie outside of it: they have stopped already.
inline void start_transmittance(const View& view, const TileFrame& frame, float* transmittance) {
  for (int block = 0; block < BLOCKS; block++)
    for (int p = 0; p < BLOCK_PIXELS; p++) {
      const int x = frame.left + block % BLOCKS_PER_ROW * BLOCK + p % BLOCK, y = frame.top + block / BLOCKS_PER_ROW * BLOCK + p / BLOCK;
      transmittance[block * BLOCK_PIXELS + p] = x < view.camera.size.x && y < view.camera.size.y ? 1.0f : 0.0f;
    }
}

struct BlendLimits {
  float log2_alpha_min, alpha_max, stop;
};

}  // namespace splat
