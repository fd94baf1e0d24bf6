// Stage 4, backward: from the gradients of the pixels to one row of sums per (splat, tile).
//
// The splats are blended front to back once more. The sum behind splat i is then the pixel's total minus the sum so far,
// so neither lists per pixel nor a division by T are needed. Per pair of splat and pixel only u = d loss / d ln(alpha) and the
// weight are kept; transposed, LANES splats become lanes, and since y is linear in the pixel's coordinates, six moments of u
// give the gradients of mean, covariance and opacity.
#pragma once

#include "output.h"
#include "splat_view.h"
#include "tile.h"

namespace splat {

struct BackwardScratch {
  Staged staged;
  alignas(64) float sums[CHUNK * ROW];
  alignas(64) float transmittance[TILE_PIXELS], behind[TILE_PIXELS];
  UpstreamPlanes upstream;
};

// Per splat (rows) and pixel of a block (lanes): LANES splats at a time.
struct PairRows {
  Floats u[LANES], weight[LANES], abs_x[LANES], abs_y[LANES];
  alignas(64) float y1[LANES], y2[LANES];  // at the block's first pixel
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

SPLAT_FN Floats sum_rows(const Floats* rows) {
  Floats sum = rows[0];
  for (int p = 1; p < LANES; p++) sum += rows[p];
  return sum;
}

SPLAT_FN Floats weighted_sum(const Floats* rows, const float* weights) {
  Floats even = {}, odd = {};
  for (int p = 0; p < LANES; p += 2) even += rows[p] * weights[p], odd += rows[p + 1] * weights[p + 1];
  return even + odd;
}

// One row of sums per splat, from the rows of its pairs with the pixels of a block.
template <bool ABSOLUTE>
SPLAT_FN void sum_pairs(PairRows& rows, const Floats* splats, const UpstreamPlanes& up, const BlockPixels& pixels, Floats* sums) {
  transpose(rows.u), transpose(rows.weight);
  whiten_moments(moments_of(rows.u), splats[0], splats[1], splats[2], load(rows.y1), load(rows.y2), sums);
  sums[RED] = weighted_sum(rows.weight, up.red + pixels.first), sums[GREEN] = weighted_sum(rows.weight, up.green + pixels.first);
  sums[BLUE] = weighted_sum(rows.weight, up.blue + pixels.first),
  sums[DEPTH] = weighted_sum(rows.weight, up.depth + pixels.first);
  if constexpr (ABSOLUTE) {
    transpose(rows.abs_x), transpose(rows.abs_y);
    sums[ABS_X] = sum_rows(rows.abs_x), sums[ABS_Y] = sum_rows(rows.abs_y);
  }
}

// Adds the sums of `count` <= LANES splats over a block to those over the tile.
template <bool ABSOLUTE>
SPLAT_FN void add_pairs(BackwardScratch& scratch, PairRows& rows, const BlockPixels& pixels, const uint16_t* list, int count) {
  Floats splats[4], sums[ROW] = {};
  load_quad_columns([&](int l) { return &row_at(scratch.staged.splats, list[std::min(l, count - 1)]).a; }, splats);
  sum_pairs<ABSOLUTE>(rows, splats, scratch.upstream, pixels, sums);
  for (int first = 0; first < SUMS; first += LANES) {
    transpose(sums + first);
    for (int l = 0; l < count; l++) {
      float* row = scratch.sums + list[l] + first;
      store(row, load(row) + sums[first + l]);
    }
  }
}

SPLAT_FN Floats absolute(Floats x) { return maximum(x, -x); }

// The state of a block in the pass front to back.
struct BlockState {
  Floats red, green, blue, depth, alpha;  // upstream
  Floats transmittance, behind;
};

SPLAT_FN BlockState load_block(const BackwardScratch& s, int at) {
  const UpstreamPlanes& up = s.upstream;
  return {load(up.red + at),   load(up.green + at),        load(up.blue + at), load(up.depth + at),
          load(up.alpha + at), load(s.transmittance + at), load(s.behind + at)};
}

// d loss / d weight of the splats of a batch.
SPLAT_FN Batch values_of(const BatchSplats& s, const BlockState& block) {
  Batch value = each([&](int k) { return s[k].depth * block.depth + block.alpha; });
  value = each([&](int k) { return s[k].blue * block.blue + value.of[k]; });
  value = each([&](int k) { return s[k].green * block.green + value.of[k]; });
  return each([&](int k) { return s[k].red * block.red + value.of[k]; });
}

// Blends a batch of splats into a block again and stores what their gradients need in the rows from `first` on.
template <bool ABSOLUTE>
SPLAT_FN void blend_backward(const BatchSplats& splats, const BlockPixels& pixels, const BlendLimits& limits, BlockState& block,
                             PairRows& rows, int first) {
  Batch y1, y2;
  const Batch alphas = alpha_of(power_at(splats, pixels, y1, y2), limits.log2_alpha_min, limits.alpha_max);
  const Batch odds = alphas / (1.0f - alphas), values = values_of(splats, block);
  for (int k = 0; k < BATCH; k++) {
    const int j = first + k;
    const LocalSplat& s = splats[k];
    const Floats alpha = alphas.of[k], value = values.of[k], weight = weight_of(alpha, block.transmittance, limits.stop);
    block.behind -= weight * value;
    const Floats u =
        blend_vjp(alpha, odds.of[k], block.transmittance, weight, value, block.behind, limits.alpha_max, limits.stop);
    block.transmittance -= alpha * block.transmittance;
    rows.u[j] = u, rows.weight[j] = weight, rows.y1[j] = y1.of[k][0], rows.y2[j] = y2.of[k][0];
    if constexpr (ABSOLUTE)
      rows.abs_x[j] = absolute(u * s.a * y1.of[k]), rows.abs_y[j] = absolute(u * (s.b * y1.of[k] + s.c * y2.of[k]));
  }
}

// Zeros for the rows from `first` on.
template <bool ABSOLUTE> SPLAT_FN void clear_rows(PairRows& rows, int first) {
  for (int j = first; j < LANES; j++) {
    rows.u[j] = rows.weight[j] = Floats{}, rows.y1[j] = rows.y2[j] = 0.0f;
    if constexpr (ABSOLUTE) rows.abs_x[j] = rows.abs_y[j] = Floats{};
  }
}

// Visits the splats of `list` in a block again.
template <bool ABSOLUTE>
SPLAT_FN void blend_block_backward(BackwardScratch& scratch, const BlockPixels& pixels, const uint16_t* list, int length,
                                   const BlendLimits& limits) {
  BlockState block = load_block(scratch, pixels.first);
  for (int i = 0; i < length; i += LANES) {
    PairRows rows;
    const int count = std::min(LANES, length - i);
    int filled = 0;
    for (; filled < count; filled += BATCH)
      blend_backward<ABSOLUTE>({scratch.staged, list + i + filled}, pixels, limits, block, rows, filled);
    clear_rows<ABSOLUTE>(rows, filled);
    add_pairs<ABSOLUTE>(scratch, rows, pixels, list + i, count);
    block.transmittance = select(block.transmittance >= limits.stop, block.transmittance, Floats{});
  }
  store(scratch.transmittance + pixels.first, block.transmittance), store(scratch.behind + pixels.first, block.behind);
}

// The sum behind the first splat: weight * value over all splats, and the background's share.
inline void start_behind(const Planes& planes, const Vec3<float>& background, BackwardScratch& scratch) {
  const UpstreamPlanes& up = scratch.upstream;
  for (int p = 0; p < TILE_PIXELS; p++) {
    const float alpha = planes.alpha[p], rest = 1.0f - alpha;
    scratch.behind[p] = up.red[p] * (planes.red[p] + rest * background.x) +
                        up.green[p] * (planes.green[p] + rest * background.y) +
                        up.blue[p] * (planes.blue[p] + rest * background.z) + up.depth[p] * planes.depth[p] + up.alpha[p] * alpha;
  }
}

inline Vec3<float> over_lanes(const Vec3<Floats>& sum) {
  Vec3<float> total = {};
  for (int l = 0; l < LANES; l++) total = total + Vec3<float>{sum.x[l], sum.y[l], sum.z[l]};
  return total;
}

// d loss / d background of one tile: the sum over its pixels of (1 - alpha) d loss / d colour, by lane first.
inline Vec3<float> background_sum(const float* alpha, const UpstreamPlanes& up) {
  Vec3<Floats> sum = {};
  for (int p = 0; p < TILE_PIXELS; p += LANES)
    sum = sum + (1.0f - load(alpha + p)) * Vec3<Floats>{load(up.red + p), load(up.green + p), load(up.blue + p)};
  return over_lanes(sum);
}

inline void store_sums(const View& view, const float* sums, int first, int count, float* slots) {
  for (int i = 0; i < count; i++) stream(slots + int64_t(view.intersections[first + i].slot) * ROW, sums + i * ROW, ROW);
}

// The rows of sums of all intersections of one tile, each into its slot; those behind the last chunk that contributes are zero.
template <bool ABSOLUTE>
inline void blend_lists_backward(const BackwardCall& call, const View& view, int tile, const TileFrame& frame,
                                 BackwardScratch& scratch) {
  const BlendLimits limits = limits_of(call.settings);
  start_transmittance(view, frame, scratch.transmittance);
  for (int first = frame.begin; first < frame.end; first += CHUNK) {
    const int count = std::min(CHUNK, frame.end - first);
    std::memset(scratch.sums, 0, sizeof(float) * ROW * count);
    const ChunkLists& lists = view.lists_of(tile, first);
    if (!lists.empty()) stage(view, frame, first, count, !lists.kept, scratch.staged);
    for_each_listed_block(scratch.staged, lists, [&](const BlockPixels& pixels, const uint16_t* list, int length) {
      blend_block_backward<ABSOLUTE>(scratch, pixels, list, length, limits);
    });
    store_sums(view, scratch.sums, first, count, call.slots(view));
  }
  end_streams();
}

// One tile of one view: fills the slots of its intersections, returns d loss / d background.
inline Vec3<float> blend_tile_backward(const BackwardCall& call, const View& view, int tile) {
  const TileFrame frame = frame_of(view, tile);
  const Layers<const float> upstream = upstream_of(call, view.index);
  if (frame.begin == frame.end) return over_lanes(sum_colors(upstream, frame, call.settings.downsample));
  BackwardScratch scratch;
  read_tile(call, view.index, frame, scratch.upstream);
  if (tile + 1 < view.tiles()) prefetch_tile<false>(upstream, frame_of(view, tile + 1), call.settings.downsample);
  start_behind(view.planes[tile], background_of(call.scene, view.index), scratch);
  if (call.out.absgrad)
    blend_lists_backward<true>(call, view, tile, frame, scratch);
  else
    blend_lists_backward<false>(call, view, tile, frame, scratch);
  return background_sum(view.planes[tile].alpha, scratch.upstream);
}

}  // namespace splat
