// Stage 6: blend the splats of a tile front to back. One block per tile and view, one warp per patch, one thread per pixel.
#include "tile.h"

namespace splat {

struct Images {
  float *image, *alpha, *depth;  // (B, H, W, 3), (B, H, W), (B, H, W) after the downsampling
  Quad* color_depth;             // (B, height, width) rendered pixels, or null: what a backward pass needs
  float* transmittance;
};

struct BlendShared {
  Stage stage;
  unsigned peaks[CHUNK];  // largest weight of each splat, as bits: positive floats compare like them
};

SPLAT_FN unsigned warp_maximum(unsigned x) {
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 800
  return __reduce_max_sync(FULL, x);
#else
  for (int step = WARP / 2; step > 0; step /= 2) x = maximum(x, __shfl_xor_sync(FULL, x, step));
  return x;
#endif
}

// Blends the hits of a group of staged splats into the pixels of this warp.
SPLAT_FN void blend_hits(BlendShared& shared, int group, const Pixel& pixel, const Settings& settings, Sums& sums) {
  Quad& c = sums.color_depth;
  for (unsigned hits = shared.stage.hits[group][pixel.patch]; hits; hits &= hits - 1) {
    const int slot = group * WARP + __ffs(hits) - 1;
    const LocalSplat s = load_staged(shared.stage, slot);
    const float alpha = alpha_of(power_at(s, pixel.local_x, pixel.local_y), settings.log2_alpha_min, settings.alpha_max);
    const float weight = weight_of(alpha, sums.transmittance, settings.stop);
    sums.transmittance = transmit(alpha, sums.transmittance, settings.stop);
    c = {c.x + weight * s.red, c.y + weight * s.green, c.z + weight * s.blue, c.w + weight * s.depth};
    const unsigned peak = warp_maximum(__float_as_uint(weight));
    if (pixel.lane == 0 && peak) atomicMax(&shared.peaks[slot], peak);
  }
}

// The mean of each 2 x 2 pixels, in the thread of the first one; its neighbours are lanes of the same warp.
SPLAT_FN float box(float x) {
  const float row = x + __shfl_xor_sync(FULL, x, 1);
  return 0.25f * (row + __shfl_xor_sync(FULL, row, PATCH_WIDTH));
}

SPLAT_FN void write_pixel(const Scene& scene, const Settings& settings, const Pixel& pixel, int view, const Sums& sums,
                          const Images& out) {
  if (out.color_depth && pixel.inside) {
    const Index at = (Index(view) * scene.height + pixel.y) * scene.width + pixel.x;
    out.color_depth[at] = sums.color_depth, out.transmittance[at] = sums.transmittance;
  }
  const int d = settings.downsample;
  const float* background = scene.background + 3 * view;
  Quad c = sums.color_depth;
  float t = sums.transmittance;
  if (d == 2) c = {box(c.x), box(c.y), box(c.z), box(c.w)}, t = box(t);
  if (!pixel.inside || pixel.x % d || pixel.y % d) return;
  const Index at = (Index(view) * (scene.height / d) + pixel.y / d) * (scene.width / d) + pixel.x / d;
  store3(out.image + 3 * at, {c.x + t * background[0], c.y + t * background[1], c.z + t * background[2]});
  out.alpha[at] = 1.0f - t, out.depth[at] = c.w;
}

}  // namespace splat

extern "C" __global__ void __launch_bounds__(256, 3)
blend(splat::Scene scene, splat::Settings settings, splat::Lists lists, splat::Images out, unsigned* contribution) {
  using namespace splat;
  __shared__ BlendShared shared;
  const TileFrame frame = frame_of(scene, lists);
  const Pixel pixel = pixel_of(scene, frame);
  Sums sums = {{0.0f, 0.0f, 0.0f, 0.0f}, pixel.inside ? 1.0f : 0.0f};
  const auto live = [&] { return pixel.inside && sums.transmittance >= settings.stop; };
  for (Index first = frame.begin; first < frame.end && __syncthreads_or(live()); first += CHUNK) {
    const int count = int(minimum<Index>(CHUNK, frame.end - first));
    if (threadIdx.x < CHUNK) shared.peaks[threadIdx.x] = 0;
    const Index owner = fill_stage(shared.stage, scene, lists, frame, first, count);
    __syncthreads();
    for (int group = 0; group * WARP < count && __any_sync(FULL, live()); group++) blend_hits(shared, group, pixel, settings, sums);
    __syncthreads();
    // A maximum is exact, so the order of the tiles doesn't matter.
    if (owner >= 0 && shared.peaks[threadIdx.x]) atomicMax(contribution + owner, shared.peaks[threadIdx.x]);
  }
  write_pixel(scene, settings, pixel, frame.view, sums, out);
}
