// The adjoint of stage 6: from the gradients of the pixels to one row of sums per intersection (splat in a tile).
//
// The splats are blended front to back once more. The sum behind splat i is then the pixel's total minus the sum so far,
// so neither lists per pixel nor a division by T are needed. Per pair of splat and pixel only u = d loss / d ln(alpha) and the
// weight are kept, in shared memory; read the other way round, lanes are splats, and since y is linear in the pixel's
// coordinates, six moments of u give the gradients of mean, covariance and opacity. No atomics: every row has one writer, and
// the warps' parts are added in the order of the warps.
#include "tile.h"

namespace splat {

struct Upstream {
  const float *image, *alpha, *depth;  // d loss / d pictures; null for zero
  const Quad* color_depth;             // what the forward blend kept
  const float* transmittance;
};

// Number of splats that are transposed into lanes at a time: each then has one lane per row of the patch. Four more columns than pixels
// spread both directions over all banks: a float per pixel is written, four at once are read.
constexpr int PAIRS = WARP / PATCH_HEIGHT, PITCH = WARP + 4;

struct alignas(16) PairRows {
  float u[PAIRS][PITCH], weight[PAIRS][PITCH];
};

struct BackwardShared {
  Stage stage;
  PairRows pairs[PATCHES];
  Row parts[PATCHES][WARP];                             // sums over a patch of each splat of a group
  Quad upstream[PATCHES][PATCH_HEIGHT][PATCH_WIDTH + 1];  // d loss / d (colour, depth) of each pixel
  unsigned summed[PATCHES];                             // which of the parts exist
};

// One pixel's gradients, and its state in the pass front to back.
struct PixelBackward {
  Quad d_color_depth;
  float d_alpha, transmittance, behind;
};

SPLAT_FN float dot_quads(const Quad& a, const Quad& b) { return a.x * b.x + (a.y * b.y + (a.z * b.z + a.w * b.w)); }

SPLAT_FN PixelBackward start_pixel(const Scene& scene, const Settings& settings, const Upstream& upstream, const Pixel& pixel, int view) {
  PixelBackward p = {};
  if (!pixel.inside) return p;
  const int d = settings.downsample;
  const float share = 1.0f / (d * d);
  const Index out = (Index(view) * (scene.height / d) + pixel.y / d) * (scene.width / d) + pixel.x / d;
  const Index at = (Index(view) * scene.height + pixel.y) * scene.width + pixel.x;
  const Vec3<float> d_image = upstream.image ? share * load3(upstream.image + 3 * out) : Vec3<float>{};
  const Vec3<float> background = load3(scene.background + 3 * view);
  p.d_color_depth = {d_image.x, d_image.y, d_image.z, upstream.depth ? share * upstream.depth[out] : 0.0f};
  p.d_alpha = upstream.alpha ? share * upstream.alpha[out] : 0.0f;
  const float left_over = upstream.transmittance[at];
  p.behind = dot_quads(p.d_color_depth, upstream.color_depth[at]) + left_over * dot(d_image, background) + p.d_alpha * (1.0f - left_over);
  p.transmittance = 1.0f;
  return p;
}

// One splat at one pixel: u and weight.
SPLAT_FN void blend_pair(const LocalSplat& s, const Pixel& pixel, const Settings& settings, PixelBackward& p, float& u, float& weight) {
  const float alpha = alpha_of(power_at(s, pixel.local_x, pixel.local_y), settings.log2_alpha_min, settings.alpha_max);
  weight = weight_of(alpha, p.transmittance, settings.stop);
  const float value = dot_quads({s.red, s.green, s.blue, s.depth}, p.d_color_depth) + p.d_alpha;
  p.behind -= weight * value;
  u = blend_vjp(alpha, alpha / (1.0f - alpha), p.transmittance, weight, value, p.behind, settings.alpha_max, settings.stop);
  p.transmittance = transmit(alpha, p.transmittance, settings.stop);
}

// The sum over the lanes that share a splat, one per row of the patch.
SPLAT_FN float across_rows(float x) {
  x += __shfl_xor_sync(FULL, x, PAIRS);
  return x + __shfl_xor_sync(FULL, x, 2 * PAIRS);
}

// A row of the patch as registers.
struct PatchRow {
  float of[PATCH_WIDTH];
};

SPLAT_FN PatchRow load_row(const float* p) {
  const Quad left = reinterpret_cast<const Quad*>(p)[0], right = reinterpret_cast<const Quad*>(p)[1];
  return {{left.x, left.y, left.z, left.w, right.x, right.y, right.z, right.w}};
}

// y of a splat at the centre of a pixel of the tile.
SPLAT_FN Vec2<float> whitened(const LocalSplat& s, float x, float y) {
  return {s.a * x + (s.b * y + s.shift_x), s.c * y + s.shift_y};
}

// This lane's row of the patch for splat `k`: moments of u, and sums of weight times gradient.
template <bool ABSOLUTE>
SPLAT_FN Row sum_pairs(const BackwardShared& shared, const LocalSplat& s, const Pixel& pixel, int k, int row) {
  const PairRows& pairs = shared.pairs[pixel.patch];
  const PatchRow all_u = load_row(&pairs.u[k][row * PATCH_WIDTH]), weights = load_row(&pairs.weight[k][row * PATCH_WIDTH]);
  const Vec2<float> left = whitened(s, pixel.corner_x, pixel.corner_y + row);
  Row r = {};
  float s0 = 0.0f, s1 = 0.0f, s2 = 0.0f;
#pragma unroll
  for (int x = 0; x < PATCH_WIDTH; x++) {
    const float u = all_u.of[x], weight = weights.of[x];
    const Quad& d = shared.upstream[pixel.patch][row][x];
    s0 += u, s1 += float(x) * u, s2 += float(x * x) * u;
    r.sums[RED] += weight * d.x, r.sums[GREEN] += weight * d.y, r.sums[BLUE] += weight * d.z, r.sums[DEPTH] += weight * d.w;
    if (ABSOLUTE) {
      const float y1 = left.x + s.a * float(x);
      r.sums[ABS_X] += fabsf(u * s.a * y1), r.sums[ABS_Y] += fabsf(u * (s.b * y1 + s.c * left.y));
    }
  }
  const float y = float(row);  // x and y are counted from the first pixel of the patch
  const Moments<float> m = {across_rows(s0), across_rows(s1),     across_rows(y * s0),
                            across_rows(s2), across_rows(y * s1), across_rows(y * y * s0)};
  const Vec2<float> first = whitened(s, pixel.corner_x, pixel.corner_y);
  whiten_moments(m, s.a, s.b, s.c, first.x, first.y, r.sums);
  for (int column = RED; column < (ABSOLUTE ? SUMS : ABS_X); column++) r.sums[column] = across_rows(r.sums[column]);
  return r;
}

// Visits the hits of a group again in this warp's patch, PAIRS at a time; returns which hits were summed.
template <bool ABSOLUTE>
SPLAT_FN unsigned blend_hits_backward(BackwardShared& shared, int group, const Pixel& pixel, const Settings& settings,
                                      PixelBackward& p) {
  PairRows& pairs = shared.pairs[pixel.patch];
  const int k = pixel.lane % PAIRS, row = pixel.lane / PAIRS;
  unsigned hits = shared.stage.hits[group][pixel.patch], summed = 0;
  while (hits && __any_sync(FULL, pixel.inside && p.transmittance >= settings.stop)) {
    int mine = -1;  // the splat that this lane sums up
    for (int pair = 0; pair < PAIRS && hits; pair++, hits &= hits - 1) {
      const int slot = __ffs(hits) - 1;
      if (pair == k) mine = slot;
      summed |= 1u << slot;
      const LocalSplat splat = load_staged(shared.stage, group * WARP + slot);
      blend_pair(splat, pixel, settings, p, pairs.u[pair][pixel.lane], pairs.weight[pair][pixel.lane]);
    }
    __syncwarp();
    // Lanes without a splat sum values of an earlier round; the result is not used.
    const LocalSplat splat = load_staged(shared.stage, group * WARP + maximum(mine, 0));
    const Row part = sum_pairs<ABSOLUTE>(shared, splat, pixel, k, row);
    if (mine >= 0 && row == 0) copy_quads(part, shared.parts[pixel.patch][mine]);
    __syncwarp();  // before the next round overwrites the pairs: shuffles let lanes meet, but order no memory
  }
  return summed;
}

// The row of one splat of a group: its parts, in the order of the patches. Three threads share a row, a quad each.
SPLAT_FN void write_rows(const BackwardShared& shared, const Lists& lists, Index first, int count, Row* rows) {
  const int slot = threadIdx.x / ROW_QUADS, quad = threadIdx.x % ROW_QUADS;
  if (slot >= count) return;
  Quad sum = {};
  for (int patch = 0; patch < PATCHES; patch++)
    if (shared.summed[patch] >> slot & 1) sum = sum + reinterpret_cast<const Quad*>(&shared.parts[patch][slot])[quad];
  reinterpret_cast<Quad*>(rows + lists.sorted[first + slot])[quad] = sum;
}

// Intersections behind the last splat that contributes to a pixel of the tile.
SPLAT_FN void clear_rows(const Lists& lists, Index first, Index end, Row* rows) {
  for (Index i = first * ROW_QUADS + threadIdx.x; i < end * ROW_QUADS; i += TILE_PIXELS)
    reinterpret_cast<Quad*>(rows + lists.sorted[i / ROW_QUADS])[i % ROW_QUADS] = {};
}

template <bool ABSOLUTE>
SPLAT_FN void blend_tile_backward(const Scene& scene, const Settings& settings, const Lists& lists, const Upstream& upstream,
                                  Row* rows) {
  __shared__ BackwardShared shared;
  const TileFrame frame = frame_of(scene, lists);
  const Pixel pixel = pixel_of(scene, frame);
  PixelBackward p = start_pixel(scene, settings, upstream, pixel, frame.view);
  shared.upstream[pixel.patch][pixel.lane / PATCH_WIDTH][pixel.lane % PATCH_WIDTH] = p.d_color_depth;
  Index first = frame.begin;
  for (; first < frame.end && __syncthreads_or(pixel.inside && p.transmittance >= settings.stop); first += CHUNK) {
    const int count = int(minimum<Index>(CHUNK, frame.end - first));
    fill_stage(shared.stage, scene, lists, frame, first, count);
    __syncthreads();
    for (int group = 0; group * WARP < count; group++) {
      const unsigned summed = blend_hits_backward<ABSOLUTE>(shared, group, pixel, settings, p);
      if (pixel.lane == 0) shared.summed[pixel.patch] = summed;
      __syncthreads();
      write_rows(shared, lists, first + group * WARP, minimum(WARP, count - group * WARP), rows);
      __syncthreads();
    }
  }
  clear_rows(lists, minimum(first, frame.end), frame.end, rows);
}

}  // namespace splat

extern "C" __global__ void __launch_bounds__(256, 3)
blend_backward(splat::Scene scene, splat::Settings settings, splat::Lists lists, splat::Upstream upstream, splat::Row* rows) {
  splat::blend_tile_backward<false>(scene, settings, lists, upstream, rows);
}

// Also fills ABS_X and ABS_Y.
extern "C" __global__ void __launch_bounds__(256, 3)
blend_backward_absolute(splat::Scene scene, splat::Settings settings, splat::Lists lists, splat::Upstream upstream,
                        splat::Row* rows) {
  splat::blend_tile_backward<true>(scene, settings, lists, upstream, rows);
}
