// Stage 5, the adjoint of stage 1: each Gaussian adds up its slots, view after view, and takes the gradient through its projection.
#pragma once

#include "blend_backward.h"
#include "project.h"

namespace splat {

constexpr float UNSCALE = 1.0f / WHITENING_SCALE;

// d loss / d viewmat but for its last row, one sum per lane.
struct ViewmatSums {
  Mat3<Floats> rotation;
  Vec3<Floats> translation;
};

// The gradients of LANES Gaussians, added up over the views.
struct WorldGradients {
  Vec3<Floats> means, colors;
  Mat3<Floats> axes;  // in the world
  Floats opacities;
};

// One view's gradients of LANES Gaussians; all zero where a Gaussian touches no tile.
struct ViewGradients {
  Vec3<Floats> t, colors;
  Mat3<Floats> axes;  // in camera coordinates
  Vec2<Floats> mean2d;
  Floats opacities;
};

// Adds up each Gaussian's slots in their order, as LANES rows; false when none of these Gaussians touches a tile.
inline bool gather_slots(const View& view, const float* slots, int64_t first, int count, float* rows, Ints& drawn) {
  const int32_t slice_slot = view.slice_of(first).first_slot;
  bool any = false;
  for (int l = 0; l < LANES; l++) {
    const Coverage c = l < count ? view.coverage[first + l] : Coverage{};
    const float* slot = slots + int64_t(slice_slot + c.slot) * ROW;
    Floats sum[ROW / LANES] = {};
    for (int s = 0; s < c.slots; s++, slot += ROW)
      for (int k = 0; k < ROW / LANES; k++) sum[k] += load(slot + k * LANES);
    for (int k = 0; k < ROW / LANES; k++) store(rows + l * ROW + k * LANES, sum[k]);
    drawn[l] = c.slots ? -1 : 0;
    any |= c.slots != 0;
  }
  return any;
}

SPLAT_FN Vec3<Floats> keep(Ints mask, const Vec3<Floats>& v) { return {select(mask, v.x, Floats{}), select(mask, v.y, Floats{}), select(mask, v.z, Floats{})}; }
SPLAT_FN Mat3<Floats> keep(Ints mask, const Mat3<Floats>& m) { return {keep(mask, m.x), keep(mask, m.y), keep(mask, m.z)}; }

// From one view's sums to its gradients.
SPLAT_FN ViewGradients project_vjp(const Camera& camera, const SplatSettings& settings, const Gaussians& g, const Mat3<Floats>& axes_in_world, const Floats* sums, Ints drawn) {
  const Projection p = project(camera, g.means, axes_in_world, settings.eps2d);
  const Whitening<Floats>& w = p.whitening;
  const Floats compensated = settings.antialias ? sums[U] : Floats{};
  const float unscale2 = UNSCALE * UNSCALE;
  const Vec2<Floats> d_mean = {UNSCALE * (w.a * sums[U_Y1]), UNSCALE * (w.b * sums[U_Y1] + w.c * sums[U_Y2])};
  ViewGradients d;
  Vec3<Floats> d_u0, d_u1;
  whiten_vjp(w, p.screen.u0, p.screen.u1, unscale2 * sums[U_Y1_Y1] - compensated, unscale2 * sums[U_Y1_Y2], unscale2 * sums[U_Y2_Y2] - compensated, d_u0, d_u1);
  if (settings.antialias) compensation_vjp(w, p.screen.u0, compensated, d_u0, d_u1);
  to_screen_vjp(camera, p.screen, p.axes, d_mean, sums[DEPTH], d_u0, d_u1, d.t, d.axes);
  d.t = keep(drawn, d.t), d.axes = keep(drawn, d.axes);
  d.mean2d = {select(drawn, d_mean.x, Floats{}), select(drawn, d_mean.y, Floats{})};
  d.opacities = select(drawn, sums[U] / g.opacities, Floats{});
  d.colors = {sums[RED], sums[GREEN], sums[BLUE]};
  return d;
}

SPLAT_FN void add_view(WorldGradients& sum, const Camera& camera, const ViewGradients& d) {
  const Mat3<Floats> d_axes = multiply_transposed(camera.rotation, d.axes);
  sum.axes = {sum.axes.x + d_axes.x, sum.axes.y + d_axes.y, sum.axes.z + d_axes.z};
  sum.means = sum.means + to_camera_vjp(camera, d.t);
  sum.colors = sum.colors + d.colors;
  sum.opacities += d.opacities;
}

// t = R mean + T and axes = R axes_in_world.
SPLAT_FN void add_viewmat(ViewmatSums& sum, const Gaussians& g, const Mat3<Floats>& axes_in_world, const ViewGradients& d, Ints drawn) {
  const Vec3<Floats> mean = keep(drawn, g.means);
  const Mat3<Floats> n = keep(drawn, axes_in_world);
  const auto row = [&](const Floats& d_t, const Vec3<Floats>& d_axis) {
    return Vec3<Floats>{d_t * mean.x + dot(d_axis, n.x), d_t * mean.y + dot(d_axis, n.y), d_t * mean.z + dot(d_axis, n.z)};
  };
  sum.rotation = {sum.rotation.x + row(d.t.x, d.axes.x), sum.rotation.y + row(d.t.y, d.axes.y), sum.rotation.z + row(d.t.z, d.axes.z)};
  sum.translation = sum.translation + d.t;
}

SPLAT_FN void store_pairs(float* p, int count, Floats x, Floats y) {
  for (int l = 0; l < count; l++) p[2 * l] = x[l], p[2 * l + 1] = y[l];
}

SPLAT_FN void store_vec3(float* p, int count, const Vec3<Floats>& v) {
  store_items<3>(p, count, [&](float* q) { store3(q, v); });
}

SPLAT_FN void store_view(const SplatGradients& out, bool colors_per_view, int64_t at, int count, const ViewGradients& d, const Floats* sums) {
  store_pairs(out.means2d + 2 * at, count, d.mean2d.x, d.mean2d.y);
  if (out.absgrad) store_pairs(out.absgrad + 2 * at, count, UNSCALE * UNSCALE * sums[ABS_X], UNSCALE * UNSCALE * sums[ABS_Y]);
  if (colors_per_view) store_vec3(out.colors + 3 * at, count, d.colors);
}

// Through rotation and scale; nothing flows to a Gaussian that isn't drawn, finite or not.
SPLAT_FN void store_world(const SplatGradients& out, bool colors_per_view, int64_t at, int count, const Gaussians& g, const Rotation<Floats>& rotation, const WorldGradients& d, Ints drawn) {
  Mat3<Floats> d_rotation;
  Vec3<Floats> d_scales;
  world_axes_vjp(rotation.matrix, g.scales, d.axes, d_rotation, d_scales);
  const Vec4<Floats> q = quat_to_rotation_vjp(rotation, d_rotation);
  const Vec4<Floats> d_quats = {select(drawn, q.w, Floats{}), select(drawn, q.x, Floats{}), select(drawn, q.y, Floats{}), select(drawn, q.z, Floats{})};
  store_vec3(out.means + 3 * at, count, d.means);
  store_vec3(out.scales + 3 * at, count, keep(drawn, d_scales));
  store_items<4>(out.quats + 4 * at, count, [&](float* p) { store4(p, d_quats); });
  store_items<1>(out.opacities + at, count, [&](float* p) { store(p, d.opacities); });
  if (!colors_per_view) store_vec3(out.colors + 3 * at, count, d.colors);
}

// The gradients of LANES Gaussians from `first` on, of which `count` exist; `viewmats` holds a sum per view, or is null.
inline void project_lanes_backward(const SplatScene& scene, const SplatSettings& settings, const Views& views, const float* slots, const int64_t* slot_begin,
                                   const SplatGradients& out, int64_t first, int count, ViewmatSums* viewmats) {
  const Gaussians g = load_gaussians(scene, first, count);
  const Rotation<Floats> rotation = quat_to_rotation(g.quats);
  const Mat3<Floats> axes = world_axes(rotation.matrix, g.scales);
  WorldGradients world = {};
  Ints drawn_anywhere = {};
  for (int v = 0; v < scene.views; v++) {
    alignas(64) float rows[LANES * ROW];
    Floats sums[ROW] = {};
    Ints drawn;
    ViewGradients d = {};
    if (gather_slots(views[v], slots + slot_begin[v] * ROW, first, count, rows, drawn)) {
      load_columns<SUMS>([&](int l) { return rows + l * ROW; }, sums);
      d = project_vjp(views[v].camera, settings, g, axes, sums, drawn);
      add_view(world, views[v].camera, d);
      if (viewmats) add_viewmat(viewmats[v], g, axes, d, drawn);
      drawn_anywhere |= drawn;
    }
    store_view(out, scene.colors_per_view, v * scene.gaussians + first, count, d, sums);
  }
  store_world(out, scene.colors_per_view, first, count, g, rotation, world, drawn_anywhere);
}

inline void store_viewmat(const ViewmatSums& sum, float* rows) {
  const Vec3<Floats>* axes = &sum.rotation.x;
  const Floats translation[3] = {sum.translation.x, sum.translation.y, sum.translation.z};
  for (int r = 0; r < 3; r++)
    for (int l = 0; l < LANES; l++)
      rows[4 * r] += axes[r].x[l], rows[4 * r + 1] += axes[r].y[l], rows[4 * r + 2] += axes[r].z[l], rows[4 * r + 3] += translation[r][l];
}

}  // namespace splat
