// Differentiable Gaussian splatting on a CPU: the C interface and the order of the stages.
//
// Stages: project (project.h), sort and bin (bin.h), blend (blend.h), output (output.h); backward: blend_backward.h,
// project_backward.h. One translation unit, compiled once per instruction set. Every sum is taken in an order that doesn't
// depend on the number of threads, so results are bit-identical for any.
#include "bin.h"
#include "blend.h"
#include "project_backward.h"

struct SplatState {
  splat::Views views;
};

namespace splat {

constexpr int BACKWARD_SLICE = 512;  // Gaussians per task, and per partial sum of d loss / d viewmats

// What only lives during a backward pass.
struct Workspace {
  Buffer<float> slots;       // (entries of all views, ROW)
  Buffer<float> background;  // (views, tiles, 3)
  Buffer<float> viewmats;    // (slices, views, 16)
};

static Pool<SplatState>& states = *new Pool<SplatState>;  // never destroyed: a thread may still be at work at exit
static Pool<Workspace>& workspaces = *new Pool<Workspace>;

static BlendLimits limits_of(const SplatSettings& s) { return {std::log2(s.alpha_min), s.alpha_max, s.stop}; }

// Stages 1 to 3 of all views: whole views in parallel when there are enough of them, else within each view.
static void build_views(const SplatScene& scene, const SplatSettings& settings, const SplatPictures& out, Views& views) {
  const bool by_view = scene.views >= settings.threads;
  parallel_for(scene.views, by_view ? settings.threads : 1,
               [&](int64_t v) { build_view(scene, settings, out, views[v], int(v), by_view ? 1 : settings.threads); });
}

static void blend_views(const SplatScene& scene, const SplatSettings& settings, const SplatPictures& out, Views& views, bool keep) {
  const int width = scene.width / settings.downsample, height = scene.height / settings.downsample, tiles = views[0].tiles();
  const BlendLimits limits = limits_of(settings);
  for (int v = 0; keep && v < scene.views; v++) views[v].block_masks.reserve(views[v].entry_count), views[v].planes.reserve(tiles);
  parallel_for(int64_t(tiles) * scene.views, settings.threads, [&](int64_t i) {
    View& view = views[i / tiles];
    const OutputPlan plan = {layers_of(out.image, out.alpha, out.depth, view.index, int64_t(width) * height), background_of(scene, view.index), width, height, settings.downsample};
    blend_tile(view, int(i % tiles), limits, plan, keep, out.contribution + view.index * scene.gaussians);
  });
}

static void forward(const SplatScene& scene, const SplatSettings& settings, const SplatPictures& out, Views& views, bool keep) {
  while (views.size() < size_t(scene.views)) views.emplace_back();
  build_views(scene, settings, out, views);
  blend_views(scene, settings, out, views, keep);
}

// Where each view's slots begin; the last element is their number.
static std::vector<int64_t> slots_of(const Views& views, int count) {
  std::vector<int64_t> begin = {0};
  for (int v = 0; v < count; v++) begin.push_back(begin.back() + views[v].entry_count);
  return begin;
}

static void blend_views_backward(const SplatScene& scene, const SplatSettings& settings, const SplatUpstream& upstream, const Views& views,
                                 const std::vector<int64_t>& slot_begin, bool absolute, Workspace& work) {
  const int width = scene.width / settings.downsample, height = scene.height / settings.downsample, tiles = views[0].tiles();
  const BlendLimits limits = limits_of(settings);
  parallel_for(int64_t(tiles) * scene.views, settings.threads, [&](int64_t i) {
    const View& view = views[i / tiles];
    const BackwardPlan plan = {layers_of(upstream.image, upstream.alpha, upstream.depth, view.index, int64_t(width) * height), background_of(scene, view.index), width, height,
                               settings.downsample, absolute};
    const Vec3<float> background = blend_tile_backward(view, int(i % tiles), limits, plan, work.slots.data() + slot_begin[view.index] * ROW);
    std::memcpy(work.background.data() + 3 * i, &background, sizeof background);
  });
}

static void project_views_backward(const SplatScene& scene, const SplatSettings& settings, const Views& views, const std::vector<int64_t>& slot_begin,
                                   const SplatGradients& out, Workspace& work) {
  const int64_t slices = (scene.gaussians + BACKWARD_SLICE - 1) / BACKWARD_SLICE;
  parallel_for(slices, settings.threads, [&](int64_t slice) {
    std::vector<ViewmatSums> sums(out.viewmats ? scene.views : 0);
    const int64_t end = std::min<int64_t>(scene.gaussians, (slice + 1) * BACKWARD_SLICE);
    for (int64_t first = slice * BACKWARD_SLICE; first < end; first += LANES)
      project_lanes_backward(scene, settings, views, work.slots.data(), slot_begin.data(), out, first, int(std::min<int64_t>(LANES, end - first)),
                             out.viewmats ? sums.data() : nullptr);
    for (size_t v = 0; v < sums.size(); v++) store_viewmat(sums[v], work.viewmats.data() + 16 * (slice * scene.views + v));
  });
}

// out[g] = the sum over i of parts[i * stride + g], in double and in the order of i.
static void sum_parts(const float* parts, int64_t count, int64_t stride, int width, float* out) {
  for (int g = 0; g < width; g++) {
    double sum = 0;
    for (int64_t i = 0; i < count; i++) sum += parts[i * stride + g];
    out[g] = float(sum);
  }
}

static void backward(const SplatScene& scene, const SplatSettings& settings, const SplatUpstream& upstream, const SplatGradients& out, const Views& views, Workspace& work) {
  const std::vector<int64_t> slot_begin = slots_of(views, scene.views);
  const int64_t tiles = views[0].tiles(), slices = (scene.gaussians + BACKWARD_SLICE - 1) / BACKWARD_SLICE;
  work.slots.reserve(slot_begin.back() * ROW), work.background.reserve(3 * tiles * scene.views);
  if (out.viewmats) std::fill_n(work.viewmats.reserve(16 * slices * scene.views), 16 * slices * scene.views, 0.0f);
  blend_views_backward(scene, settings, upstream, views, slot_begin, out.absgrad != nullptr, work);
  project_views_backward(scene, settings, views, slot_begin, out, work);
  for (int v = 0; v < scene.views; v++) {
    sum_parts(work.background.data() + 3 * tiles * v, tiles, 3, 3, out.background + 3 * v);
    if (out.viewmats) sum_parts(work.viewmats.data() + 16 * v, slices, 16 * scene.views, 16, out.viewmats + 16 * v);
  }
}

}  // namespace splat

extern "C" {

int64_t splat_forward(const SplatScene* scene, const SplatSettings* settings, const SplatPictures* out, SplatState** state) {
  std::unique_ptr<SplatState> own = splat::states.take();
  try {
    splat::forward(*scene, *settings, *out, own->views, state != nullptr);
  } catch (const splat::OutOfMemory& e) {
    return e.bytes;
  } catch (const std::bad_alloc&) {
    return -1;
  }
  if (state) *state = own.release();
  else splat::states.give(std::move(own));
  return 0;
}

int64_t splat_backward(SplatState* state, const SplatScene* scene, const SplatSettings* settings, const SplatUpstream* upstream, const SplatGradients* out) {
  std::unique_ptr<splat::Workspace> work = splat::workspaces.take();
  try {
    splat::backward(*scene, *settings, *upstream, *out, state->views, *work);
  } catch (const splat::OutOfMemory& e) {
    return e.bytes;
  } catch (const std::bad_alloc&) {
    return -1;
  }
  splat::workspaces.give(std::move(work));
  return 0;
}

void splat_release(SplatState* state) { splat::states.give(std::unique_ptr<SplatState>(state)); }

const char* splat_best_isa() {
#if defined(__x86_64__)
  __builtin_cpu_init();
  if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("avx512cd")) return "v4";
  if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("bmi2")) return "v3";
#endif
  return "base";
}

}  // extern "C"
