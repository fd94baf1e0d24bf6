// Stage 4, backward: from the gradients of the pixels to one row of sums per (splat, tile).
//
// The splats are blended front to back once more. What lies behind splat i is then the pixel's total minus what came so far,
// so neither lists per pixel nor a division by T are needed. Per pair of splat and pixel only u = d loss / d ln(alpha) and the
// weight are kept; transposed, LANES splats become lanes, and since y is linear in the pixel's coordinates, six moments of u
// give the gradients of mean, covariance and opacity.
#pragma once

#include "output.h"
#include "tile.h"

namespace splat {

// Columns of a row of sums over the pixels of a tile, for one splat.
enum Sum { U, U_Y1, U_Y2, U_Y1_Y1, U_Y1_Y2, U_Y2_Y2, RED, GREEN, BLUE, DEPTH, ABS_X, ABS_Y, SUMS };

struct BackwardScratch {
  alignas(64) LocalSplat splats[CHUNK];
  alignas(64) float sums[CHUNK * ROW];
  alignas(64) float transmittance[TILE_PIXELS], behind[TILE_PIXELS];
  BlockLists lists;
  UpstreamPlanes upstream;
};

// Per splat (rows) and pixel of a strip (lanes): LANES splats at a time.
struct PairRows {
  Floats u[LANES], weight[LANES], abs_x[LANES], abs_y[LANES];
};

struct StripUpstream {
  Floats red, green, blue, depth, alpha;
};

// Moments of u over a strip, one splat per lane: sums of u x^i y^j with x, y counted from the strip's first pixel.
struct Moments {
  Floats m00, m10, m01, m20, m11, m02;
};

SPLAT_FN Moments moments_of(const Floats* u) {
  constexpr int ROWS = LANES / BLOCK;
  Floats s0[4] = {}, s1[4] = {}, s2[4] = {};
  for (int y = 0; y < ROWS; y++) {
    const Floats* p = u + BLOCK * y;
    s0[y] = (p[0] + p[1]) + (p[2] + p[3]);
    s1[y] = p[1] + 2.0f * p[2] + 3.0f * p[3];
    s2[y] = p[1] + 4.0f * p[2] + 9.0f * p[3];
  }
  return {(s0[0] + s0[1]) + (s0[2] + s0[3]), (s1[0] + s1[1]) + (s1[2] + s1[3]), s0[1] + 2.0f * s0[2] + 3.0f * s0[3],
          (s2[0] + s2[1]) + (s2[2] + s2[3]), s1[1] + 2.0f * s1[2] + 3.0f * s1[3], s0[1] + 4.0f * s0[2] + 9.0f * s0[3]};
}

// Sums of u, u y and u y y' with y = (y1, y2) at the strip's first pixel plus (a x + b y, c y).
SPLAT_FN void whiten_moments(const Moments& m, const Floats* splat, const StripPixels& pixels, Floats* sums) {
  const Floats a = splat[0], b = splat[1], c = splat[2];
  const Floats y1 = a * pixels.left + (b * pixels.top + splat[3]), y2 = c * pixels.top + splat[4];
  const Floats step1 = a * m.m10 + b * m.m01, step2 = c * m.m01;
  sums[U] = m.m00;
  sums[U_Y1] = y1 * m.m00 + step1;
  sums[U_Y2] = y2 * m.m00 + step2;
  sums[U_Y1_Y1] = y1 * (sums[U_Y1] + step1) + a * (a * m.m20 + 2.0f * b * m.m11) + b * b * m.m02;
  sums[U_Y1_Y2] = y2 * sums[U_Y1] + y1 * step2 + c * (a * m.m11 + b * m.m02);
  sums[U_Y2_Y2] = y2 * (sums[U_Y2] + step2) + c * c * m.m02;
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

// Adds the sums of `count` pairs of rows to those of the splats `list[0..count)`.
template <bool ABSOLUTE> SPLAT_FN void add_sums(BackwardScratch& scratch, PairRows& rows, const StripPixels& pixels, const uint16_t* list, int count) {
  Floats splats[ROW], sums[ROW] = {};
  load_columns<5>([&](int l) { return &scratch.splats[list[std::min(l, count - 1)]].a; }, splats);
  transpose(rows.u), transpose(rows.weight);
  whiten_moments(moments_of(rows.u), splats, pixels, sums);
  sums[RED] = weighted_sum(rows.weight, scratch.upstream.red + pixels.first), sums[GREEN] = weighted_sum(rows.weight, scratch.upstream.green + pixels.first);
  sums[BLUE] = weighted_sum(rows.weight, scratch.upstream.blue + pixels.first), sums[DEPTH] = weighted_sum(rows.weight, scratch.upstream.depth + pixels.first);
  if constexpr (ABSOLUTE) {
    transpose(rows.abs_x), transpose(rows.abs_y);
    sums[ABS_X] = sum_rows(rows.abs_x), sums[ABS_Y] = sum_rows(rows.abs_y);
  }
  for (int first = 0; first < SUMS; first += LANES) {
    transpose(sums + first);
    for (int l = 0; l < count; l++) {
      float* row = scratch.sums + list[l] * ROW + first;
      store(row, load(row) + sums[first + l]);
    }
  }
}

SPLAT_FN Floats absolute(Floats x) { return maximum(x, -x); }

// Goes once more over the splats of `list` in a strip; false when all its pixels have stopped.
template <bool ABSOLUTE>
SPLAT_FN bool blend_strip_backward(BackwardScratch& scratch, const StripPixels& pixels, const uint16_t* list, int count, const BlendLimits& limits) {
  const int at = pixels.first;
  const UpstreamPlanes& up = scratch.upstream;
  const Floats d_red = load(up.red + at), d_green = load(up.green + at), d_blue = load(up.blue + at), d_depth = load(up.depth + at), d_alpha = load(up.alpha + at);
  Floats transmittance = load(scratch.transmittance + at), behind = load(scratch.behind + at);
  bool live = true;
  for (int i = 0; i < count && live; i += LANES) {
    PairRows rows;
    const int group = std::min(LANES, count - i);
    for (int j = 0; j < group; j++) {
      const LocalSplat& s = scratch.splats[list[i + j]];
      Floats y1, y2;
      const Floats alpha = alpha_of(power_at(s, pixels, y1, y2), limits.log2_alpha_min, limits.alpha_max);
      const Floats weight = weight_of(alpha, transmittance, limits.stop);
      const Floats value = s.red * d_red + (s.green * d_green + (s.blue * d_blue + (s.depth * d_depth + d_alpha)));
      behind -= weight * value;
      const Floats u = blend_vjp(alpha, transmittance, weight, value, behind, limits.alpha_max, limits.stop);
      transmittance -= alpha * transmittance;
      rows.u[j] = u, rows.weight[j] = weight;
      if constexpr (ABSOLUTE) rows.abs_x[j] = absolute(u * s.a * y1), rows.abs_y[j] = absolute(u * (s.b * y1 + s.c * y2));
    }
    for (int j = group; j < LANES; j++) rows.u[j] = rows.weight[j] = rows.abs_x[j] = rows.abs_y[j] = Floats{};
    add_sums<ABSOLUTE>(scratch, rows, pixels, list + i, group);
    transmittance = select(transmittance >= limits.stop, transmittance, Floats{});
    live = any_at_least(transmittance, limits.stop);
  }
  store(scratch.transmittance + at, transmittance), store(scratch.behind + at, behind);
  return live;
}

// The sum over all splats of weight * value, and the background's share: what lies behind the camera's near plane.
inline void start_behind(const Planes& planes, const Vec3<float>& background, BackwardScratch& scratch) {
  const UpstreamPlanes& up = scratch.upstream;
  for (int p = 0; p < TILE_PIXELS; p++) {
    const float t = planes.transmittance[p];
    scratch.behind[p] = up.red[p] * (planes.red[p] + t * background.x) + up.green[p] * (planes.green[p] + t * background.y) +
                        up.blue[p] * (planes.blue[p] + t * background.z) + up.depth[p] * planes.depth[p] + up.alpha[p] * (1.0f - t);
  }
}

// d loss / d background of one tile: a sum over its pixels, by lane first.
inline Vec3<float> background_sum(const float* transmittance, const UpstreamPlanes& up) {
  Vec3<Floats> sum = {};
  for (int p = 0; p < TILE_PIXELS; p += LANES) sum = sum + load(transmittance + p) * Vec3<Floats>{load(up.red + p), load(up.green + p), load(up.blue + p)};
  Vec3<float> total = {};
  for (int l = 0; l < LANES; l++) total = total + Vec3<float>{sum.x[l], sum.y[l], sum.z[l]};
  return total;
}

template <bool ABSOLUTE> inline int blend_chunk_backward(BackwardScratch& scratch, uint64_t* live, const BlendLimits& limits) {
  int left = 0;
  for (int block = 0; block < BLOCKS; block++)
    for (int strip = 0; strip < STRIPS; strip++) {
      if (!(live[strip] >> block & 1)) continue;
      if (blend_strip_backward<ABSOLUTE>(scratch, strip_pixels(block, strip), scratch.lists.splats[block], scratch.lists.lengths[block], limits))
        left++;
      else
        live[strip] &= ~(uint64_t(1) << block);
    }
  return left;
}

// The rows of sums of all entries of one tile, each into its slot; those behind the last chunk that counted are zero.
template <bool ABSOLUTE> inline void blend_entries_backward(const View& view, const TileFrame& frame, BackwardScratch& scratch, const BlendLimits& limits, float* slots) {
  uint64_t live[STRIPS];
  std::fill(live, live + STRIPS, ~uint64_t(0));
  start_transmittance(view, frame, scratch.transmittance);
  for (int first = frame.begin, left = 1; first < frame.end; first += CHUNK) {
    const int count = std::min(CHUNK, frame.end - first);
    std::memset(scratch.sums, 0, sizeof(float) * ROW * count);
    if (left) {
      stage(view, frame, first, count, scratch.splats, scratch.lists, [&](int entry, const Splat&) { return view.block_masks[entry]; });
      left = blend_chunk_backward<ABSOLUTE>(scratch, live, limits);
    }
    for (int i = 0; i < count; i++) std::memcpy(slots + int64_t(view.entries[first + i].slot) * ROW, scratch.sums + i * ROW, sizeof(float) * ROW);
  }
}

struct BackwardPlan {
  Layers<const float> upstream;
  Vec3<float> background;
  int width, height, downsample;  // of the pictures
  bool absolute;
};

// One tile of one view: fills the slots of its entries, returns d loss / d background.
inline Vec3<float> blend_tile_backward(const View& view, int tile, const BlendLimits& limits, const BackwardPlan& plan, float* slots) {
  const TileFrame frame = frame_of(view, tile);
  BackwardScratch scratch;
  read_tile(plan.upstream, plan.width, plan.height, plan.downsample, frame, scratch.upstream);
  if (frame.begin == frame.end) {
    std::fill(scratch.transmittance, scratch.transmittance + TILE_PIXELS, 1.0f);
    return background_sum(scratch.transmittance, scratch.upstream);
  }
  start_behind(view.planes[tile], plan.background, scratch);
  if (plan.absolute)
    blend_entries_backward<true>(view, frame, scratch, limits, slots);
  else
    blend_entries_backward<false>(view, frame, scratch, limits, slots);
  return background_sum(view.planes[tile].transmittance, scratch.upstream);
}

}  // namespace splat
