// Stage 4, backward: from the gradients of the pixels to one row of sums per (splat, tile).
//
// The splats of a block are blended twice: front to back for their alphas and weights, then back to front for `behind`, the
// value of what lies behind a splat, seen without what lies before it. That needs neither a division by the transmittance nor
// a difference of sums, and nothing of the pictures. u = d loss / d ln(alpha) is kept for LANES splats at a time; transposed,
// the splats become lanes, and since y is linear in the pixel's coordinates, six moments of u give the gradients of mean,
// covariance and opacity.
#pragma once

#include "output.h"
#include "splat_view.h"
#include "tile.h"

namespace splat {

// The alphas and weights of the splats of one block's list in its pixels, front to back.
struct BlendedList {
  Floats alpha[CHUNK], weight[CHUNK];
};

struct BackwardScratch {
  Staged staged;
  BlendedList blended;
  alignas(64) float sums[CHUNK * ROW];
  alignas(64) float transmittance[TILE_PIXELS], behind[TILE_PIXELS];
  UpstreamPlanes upstream;
};

// Per splat (rows) and pixel of a block (lanes): LANES splats at a time.
struct PairRows {
  Floats u[LANES], abs_x[LANES], abs_y[LANES];
};

// Over a block, one splat per lane, counted from the block's first pixel.
SPLAT_FN Moments<Floats> moments_of(const Floats* u) {
  Floats s0[4] = {}, s1[4] = {}, s2[4] = {};
  for (int y = 0; y < BLOCK_HEIGHT; y++) {
    const Floats* p = u + BLOCK_WIDTH * y;
    s0[y] = (p[0] + p[1]) + (p[2] + p[3]);
    s1[y] = p[1] + 2.0f * p[2] + 3.0f * p[3];
    s2[y] = p[1] + 4.0f * p[2] + 9.0f * p[3];
  }
  return {(s0[0] + s0[1]) + (s0[2] + s0[3]), (s1[0] + s1[1]) + (s1[2] + s1[3]),   s0[1] + 2.0f * s0[2] + 3.0f * s0[3],
          (s2[0] + s2[1]) + (s2[2] + s2[3]), s1[1] + 2.0f * s1[2] + 3.0f * s1[3], s0[1] + 4.0f * s0[2] + 9.0f * s0[3]};
}

// The pixels of a block, one splat per lane, from its splats' rows.
struct PixelColumns {
  Floats of[LANES];
};

SPLAT_FN PixelColumns pixels_of(const Floats* rows) {
  PixelColumns pixels;
  load_columns<LANES>([&](int l) { return reinterpret_cast<const float*>(rows + l); }, pixels.of);
  return pixels;
}

SPLAT_FN Floats sum_of(const PixelColumns& pixels) {
  Floats sum = pixels.of[0];
  for (int p = 1; p < LANES; p++) sum += pixels.of[p];
  return sum;
}

SPLAT_FN Floats weighted_sum(const PixelColumns& pixels, const float* weights) {
  Floats even = {}, odd = {};
  for (int p = 0; p < LANES; p += 2) even += pixels.of[p] * weights[p], odd += pixels.of[p + 1] * weights[p + 1];
  return even + odd;
}

// a, b, c, shift_x and shift_y of a LocalSplat, one splat per lane; the others aren't used.
using LocalColumns = Floats[8];

// One row of sums per splat, from the rows of its pairs with the pixels of a block.
template <bool ABSOLUTE>
SPLAT_FN void sum_pairs(const PairRows& rows, const Floats* weight_rows, const LocalColumns& s, const UpstreamPlanes& up,
                        const BlockPixels& pixels, Floats* sums) {
  const Floats y1 = s[0] * pixels.left + (s[1] * pixels.top + s[3]), y2 = s[2] * pixels.top + s[4];
  whiten_moments(moments_of(pixels_of(rows.u).of), s[0], s[1], s[2], y1, y2, sums);
  const PixelColumns weights = pixels_of(weight_rows);
  sums[RED] = weighted_sum(weights, up.red + pixels.first), sums[GREEN] = weighted_sum(weights, up.green + pixels.first);
  sums[BLUE] = weighted_sum(weights, up.blue + pixels.first), sums[DEPTH] = weighted_sum(weights, up.depth + pixels.first);
  if constexpr (ABSOLUTE) sums[ABS_X] = sum_of(pixels_of(rows.abs_x)), sums[ABS_Y] = sum_of(pixels_of(rows.abs_y));
}

// Adds the sums of `count` <= LANES splats over a block to those over the tile; the list has LANES entries, see list_filled.
template <bool ABSOLUTE>
SPLAT_FN void add_pairs(BackwardScratch& scratch, const PairRows& rows, const Floats* weights, const BlockPixels& pixels,
                        const uint16_t* list, int count) {
  LocalColumns columns;
  Floats sums[ROW] = {};
  load_columns<8>([&](int l) { return &row_at(scratch.staged.splats, list[l]).a; }, columns);
  sum_pairs<ABSOLUTE>(rows, weights, columns, scratch.upstream, pixels, sums);
  for (int first = 0; first < SUMS; first += LANES) {
    transpose(sums + first);
    for (int l = 0; l < count; l++) {
      float* row = scratch.sums + list[l] + first;
      store(row, load(row) + sums[first + l]);
    }
  }
}

SPLAT_FN Floats absolute(Floats x) { return maximum(x, -x); }

// What the pixels of a block receive, and the state of the pass back to front.
struct BlockState {
  Floats red, green, blue, depth, alpha;  // upstream
  Floats behind;
};

SPLAT_FN BlockState load_block(const BackwardScratch& s, int at) {
  const UpstreamPlanes& up = s.upstream;
  return {load(up.red + at),   load(up.green + at), load(up.blue + at),
          load(up.depth + at), load(up.alpha + at), load(s.behind + at)};
}

// d loss / d weight of the splats of a batch.
SPLAT_FN Batch<BATCH> values_of(const BatchSplats& s, const BlockState& block) {
  Batch<BATCH> value = each<BATCH>([&](int k) { return s[k].depth * block.depth + block.alpha; });
  value = each<BATCH>([&](int k) { return s[k].blue * block.blue + value.of[k]; });
  value = each<BATCH>([&](int k) { return s[k].green * block.green + value.of[k]; });
  return each<BATCH>([&](int k) { return s[k].red * block.red + value.of[k]; });
}

// Front to back: the alphas of a list of splats, zero where a pixel has stopped, and their weights. Transmittance and weight are
// computed as in the forward pass, so that both stop at the same splat.
SPLAT_FN void blend_again(BackwardScratch& scratch, const BlockPixels& pixels, const uint16_t* list, int length,
                          const BlendLimits& limits) {
  BlendedList& blended = scratch.blended;
  Floats transmittance = load(scratch.transmittance + pixels.first);
  in_batches(length, [&](auto batch, int first) __attribute__((always_inline)) {
    const auto powers = power_at<batch.value>({scratch.staged, list + first}, pixels);
    const auto alphas = alpha_of(powers, limits.log2_alpha_min, limits.alpha_max);
    for (int k = 0; k < batch.value; k++) {
      const Floats alpha = alphas.of[k], weight = weight_of(alpha, transmittance, limits.stop);
      blended.alpha[first + k] = select(transmittance >= limits.stop, alpha, Floats{}), blended.weight[first + k] = weight;
      transmittance -= alpha * transmittance;
    }
    transmittance = select(transmittance >= limits.stop, transmittance, Floats{});  // avoids denormals
    return true;
  });
  for (int i = whole_batches(length); i < whole_vectors(length); i++) blended.weight[i] = Floats{};  // as clear_rows
}

// Back to front: what the gradients of a batch of splats need, to the rows from `row` on.
template <bool ABSOLUTE>
SPLAT_FN void differentiate(const BatchSplats& splats, const Floats* alphas, const Floats* weights, const BlockPixels& pixels,
                            float alpha_max, BlockState& block, PairRows& rows, int row) {
  const Batch<BATCH> values = values_of(splats, block);
  for (int k = BATCH - 1; k >= 0; k--) {
    const Floats u = rows.u[row + k] = blend_vjp_back_to_front(alphas[k], weights[k], values.of[k], alpha_max, block.behind);
    if constexpr (ABSOLUTE) {
      const LocalSplat& s = splats[k];
      const Floats y1 = s.a * pixels.x + (s.b * pixels.y + s.shift_x), y2 = s.c * pixels.y + s.shift_y;
      rows.abs_x[row + k] = absolute(u * s.a * y1), rows.abs_y[row + k] = absolute(u * (s.b * y1 + s.c * y2));
    }
  }
}

// Zeros for the rows from `first` on: nobody reads their sums, but denormals would be slow.
template <bool ABSOLUTE> SPLAT_FN void clear_rows(PairRows& rows, int first) {
  for (int j = first; j < LANES; j++) {
    rows.u[j] = Floats{};
    if constexpr (ABSOLUTE) rows.abs_x[j] = rows.abs_y[j] = Floats{};
  }
}

// Blends the splats of `list` into a block again and adds up their gradients.
template <bool ABSOLUTE>
SPLAT_FN void blend_block_backward(BackwardScratch& scratch, const BlockPixels& pixels, const uint16_t* list, int length,
                                   const BlendLimits& limits) {
  blend_again(scratch, pixels, list, length, limits);
  BlockState block = load_block(scratch, pixels.first);
  for (int first = (length - 1) / LANES * LANES; first >= 0; first -= LANES) {
    const Floats* alphas = scratch.blended.alpha + first;
    const Floats* weights = scratch.blended.weight + first;
    PairRows rows;
    const int filled = std::min(LANES, whole_batches(length - first));
    clear_rows<ABSOLUTE>(rows, filled);
    for (int row = filled - BATCH; row >= 0; row -= BATCH) {
      const BatchSplats splats = {scratch.staged, list + first + row};
      differentiate<ABSOLUTE>(splats, alphas + row, weights + row, pixels, limits.alpha_max, block, rows, row);
    }
    add_pairs<ABSOLUTE>(scratch, rows, weights, pixels, list + first, std::min(LANES, length - first));
  }
  store(scratch.behind + pixels.first, block.behind);
}

// Behind the last splat there is the background.
inline void start_behind(const Vec3<float>& background, BackwardScratch& scratch) {
  const UpstreamPlanes& up = scratch.upstream;
  for (int p = 0; p < TILE_PIXELS; p += LANES)
    store(scratch.behind + p,
          load(up.red + p) * background.x + load(up.green + p) * background.y + load(up.blue + p) * background.z);
}

inline void store_sums(const View& view, const float* sums, int first, int count, float* slots) {
  for (int i = 0; i < count; i++) stream(slots + int64_t(view.intersections[first + i].slot) * ROW, sums + i * ROW, ROW);
}

// Of the pixels of a tile, before one of its chunks.
inline void transmittance_before(const View& view, const TileFrame& frame, int first, const ChunkLists& lists,
                                 float* transmittance) {
  if (first == frame.begin) return start_transmittance(view, frame, transmittance);
  std::copy_n(lists.transmittance.data(), TILE_PIXELS, transmittance);
}

// The rows of sums of all intersections of one tile, each into its slot; those behind the last chunk that contributes are zero.
template <bool ABSOLUTE>
inline void blend_lists_backward(const BackwardCall& call, const View& view, int tile, const TileFrame& frame,
                                 BackwardScratch& scratch) {
  const BlendLimits limits = limits_of(call.settings);
  for (int first = frame.last_chunk(); first >= frame.begin; first -= CHUNK) {
    const int count = std::min(CHUNK, frame.end - first);
    std::memset(scratch.sums, 0, sizeof(float) * ROW * count);
    const ChunkLists& lists = view.lists_of(tile, first);
    if (!lists.empty()) {
      stage(view, frame, first, count, !lists.kept, scratch.staged);
      transmittance_before(view, frame, first, lists, scratch.transmittance);
    }
    for_each_listed_block(scratch.staged, lists, [&](const BlockPixels& pixels, const uint16_t* list, int length) {
      blend_block_backward<ABSOLUTE>(scratch, pixels, list, length, limits);
    });
    store_sums(view, scratch.sums, first, count, call.slots(view));
  }
  end_streams();
}

// One tile of one view: fills the slots of its intersections.
inline void blend_tile_backward(const BackwardCall& call, const View& view, int tile) {
  const TileFrame frame = frame_of(view, tile);
  if (frame.begin == frame.end) return;
  BackwardScratch scratch;
  read_tile(call, view.index, frame, scratch.upstream);
  if (tile + 1 < view.tiles())
    prefetch_tile<false>(upstream_of(call, view.index), frame_of(view, tile + 1), call.settings.downsample);
  start_behind(background_of(call.scene, view.index), scratch);
  if (call.out.absgrad)
    blend_lists_backward<true>(call, view, tile, frame, scratch);
  else
    blend_lists_backward<false>(call, view, tile, frame, scratch);
}

}  // namespace splat
