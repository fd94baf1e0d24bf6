// Differentiable Gaussian splatting on a CPU: the C interface and the order of the stages.
//
// Stages: project (project.h), sort and bin (bin.h), blend (blend.h), output (output.h); backward: blend_backward.h,
// project_backward.h. One translation unit, compiled once per instruction set. Every sum is taken in an order that doesn't
// depend on the number of threads, so results are bit-identical for any.
#include "bin.h"
#include "blend.h"
#include "known_picture.h"
#include "project_backward.h"

struct SplatState {
  splat::Views views;
};

namespace splat {

constexpr int TILE_GRAIN = 4;        // adjacent tiles share splats, hence cache lines
constexpr int BACKWARD_SLICE = 512;  // Gaussians per task, and per partial sum of d loss / d viewmats

static Pool<SplatState>& states() { return of_process<Pool<SplatState>>(); }
static Pool<Workspace>& workspaces() { return of_process<Pool<Workspace>>(); }

static void blend_views(const ForwardCall& call, Views& views) {
  const int tiles = views[0].tiles();
  for (int v = 0; v < call.scene.views; v++) {
    views[v].peaks.reserve(views[v].intersection_count);
    if (!call.keep) continue;
    while (views[v].lists.size() < size_t(views[v].intersection_count / CHUNK + tiles)) views[v].lists.emplace_back();
  }
  parallel_for(int64_t(tiles) * call.scene.views, call.settings.threads, TILE_GRAIN,
               [&](int64_t i) { blend_tile(call, views[i / tiles], int(i % tiles)); });
  const int64_t slices = views[0].slices.size();
  parallel_for(slices * call.scene.views, call.settings.threads, 1,
               [&](int64_t i) { store_contributions(call, views[i / slices], i % slices); });
}

static void forward(const ForwardCall& call, Views& views) {
  build_views(call, views);
  int64_t intersections = 0;
  for (int v = 0; v < call.scene.views; v++) intersections += views[v].intersection_count;
  check_memory(bytes_of(intersections, call.keep));
  blend_views(call, views);
}

static int64_t slices_of(const Scene& scene) { return (scene.gaussians + BACKWARD_SLICE - 1) / BACKWARD_SLICE; }

// Numbers the slots of all views and allocates the buffers of the backward pass.
static void prepare(BackwardCall& call) {
  int64_t slots = 0;
  for (int v = 0; v < call.scene.views; v++) call.first_slots.push_back(slots), slots += call.views[v].intersection_count;
  call.work.slots.reserve((slots + 2) * ROW);  // gather_slots reads two
  const int64_t viewmats = call.out.viewmats ? 16 * slices_of(call.scene) * call.scene.views : 0;
  std::fill_n(call.work.viewmats.reserve(viewmats), viewmats, 0.0f);
}

static void blend_views_backward(const BackwardCall& call) {
  const int tiles = call.views[0].tiles();
  parallel_for(int64_t(tiles) * call.scene.views, call.settings.threads, TILE_GRAIN,
               [&](int64_t i) { blend_tile_backward(call, call.views[i / tiles], int(i % tiles)); });
}

static void project_slice_backward(const BackwardCall& call, int64_t slice) {
  std::vector<ViewmatSums> viewmats(call.out.viewmats ? call.scene.views : 0);
  const int64_t end = std::min<int64_t>(call.scene.gaussians, (slice + 1) * BACKWARD_SLICE);
  for_each_group(slice * BACKWARD_SLICE, end, [&](Group group) { project_group_backward(call, group, viewmats); });
  float* matrices = call.work.viewmats.data() + 16 * slice * call.scene.views;
  for (size_t v = 0; v < viewmats.size(); v++) store_viewmat(viewmats[v], matrices + 16 * v);
}

// Adds up the parts of d loss / d viewmats, in double and in their order.
static void sum_viewmats(const BackwardCall& call) {
  const int64_t width = 16 * call.scene.views;
  for (int64_t i = 0; i < width; i++) {
    double sum = 0;
    for (int64_t slice = 0; slice < slices_of(call.scene); slice++) sum += call.work.viewmats[slice * width + i];
    call.out.viewmats[i] = float(sum);
  }
}

static void backward(BackwardCall call) {
  prepare(call);
  blend_views_backward(call);
  parallel_for(slices_of(call.scene), call.settings.threads, 1, [&](int64_t slice) { project_slice_backward(call, slice); });
  if (call.out.viewmats) sum_viewmats(call);
}

// 0, or the bytes that couldn't be allocated; -1 if their number is unknown.
template <class Body> static int64_t guarded(const Body& body) {
  try {
    body();
    return 0;
  } catch (const OutOfMemory& e) {
    return e.bytes;
  } catch (const std::bad_alloc&) {
    return -1;
  }
}

}  // namespace splat

extern "C" {

int32_t splat_interface() { return SPLAT_INTERFACE; }

void splat_set_memory(int64_t bytes) { splat::memory_of_machine() = bytes; }

int64_t splat_forward(const splat::Scene* scene, const SplatSettings* settings, const SplatPictures* out, SplatState** state) {
  return splat::guarded([&] {
    std::unique_ptr<SplatState> own = splat::states().take();
    splat::forward({*scene, *settings, *out, state != nullptr}, own->views);
    if (state)
      *state = own.release();
    else
      splat::states().give(std::move(own));
  });
}

int64_t splat_backward(SplatState* state, const splat::Scene* scene, const SplatSettings* settings, const SplatUpstream* upstream,
                       const SplatGradients* out) {
  return splat::guarded([&] {
    std::unique_ptr<splat::Workspace> work = splat::workspaces().take();
    splat::backward({*scene, *settings, *upstream, *out, state->views, {}, *work});
    splat::workspaces().give(std::move(work));
  });
}

void splat_release(SplatState* state) {
  if (state) splat::states().give(std::unique_ptr<SplatState>(state));
}

int64_t splat_gradients_to_pictures(const SplatKnownPictures* in, const SplatKnownGradient* out) {
  return splat::guarded([&] { splat::known_gradients(*in, *out); });
}

const char* splat_best_isa() {
#if defined(__x86_64__)
  __builtin_cpu_init();
  const bool v3 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("bmi2");
  const bool v4 = __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512cd") &&
                  __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl");
  return v3 && v4 ? "v4" : v3 ? "v3" : "base";
#else
  return "base";
#endif
}

}  // extern "C"
