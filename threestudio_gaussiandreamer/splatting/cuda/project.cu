// Stage 1: Gaussians to splats. One thread per Gaussian and view.
#include "launch.h"

namespace splat {

SPLAT_FN Splat make_splat(const Projection<float>& p, const Reach<float>& reach, const Vec3<float>& color) {
  Splat splat;
  splat_columns(p, reach, color, &splat.x);
  return splat;
}

SPLAT_FN Splat nothing() {
  Splat splat = {};
  splat.level = -1.0f;
  return splat;
}

}  // namespace splat

// Fills (B, N) arrays. Depth keys order as the depths do: positive floats compare like their bits.
extern "C" __global__ void __launch_bounds__(128)
project(splat::Scene scene, splat::Settings settings, splat::Splat* splats, int* depth_keys, float* means2d, float* radii,
        float* contribution) {
  using namespace splat;
  const int i = blockIdx.x * blockDim.x + threadIdx.x, view = blockIdx.y;
  if (i >= scene.gaussians) return;
  const Camera camera = make_camera(scene, view);
  const Gaussian<float> g = load_gaussian(scene, settings, i);
  const Vec3<float> color = load3(color_of(scene, view, i));
  const Mat3<float> axes = world_axes(quat_to_rotation(g.quat).matrix, g.scale);
  const Projection<float> p = splat::project(camera, g.mean, axes, settings.eps2d);
  const Reach<float> reach = reach_of(p, g.opacity, settings.antialias, settings.log2_alpha_min);
  const bool visible = all_finite(g, color) & is_visible(camera, p, reach, settings.near, settings.far);

  const Index at = Index(view) * scene.gaussians + i;
  copy_quads(visible ? make_splat(p, reach, color) : nothing(), splats[at]);
  depth_keys[at] = visible ? __float_as_int(p.t.z) : CULLED;
  means2d[2 * at] = visible ? p.screen.mean.x : 0.0f;
  means2d[2 * at + 1] = visible ? p.screen.mean.y : 0.0f;
  radii[at] = visible ? maximum(reach.extent.x, reach.extent.y) : 0.0f;
  contribution[at] = 0.0f;
}
