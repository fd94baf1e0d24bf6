// Stage 5, the adjoint of stage 1: each Gaussian adds up its slots, view after view, and takes the gradient through its
// projection.
#pragma once

#include "blend_backward.h"
#include "project.h"

namespace splat {

// d loss / d viewmat but for its last row, one sum per lane.
struct ViewmatSums {
  Mat3<Floats> rotation;
  Vec3<Floats> translation;
};

SPLAT_FN Floats keep(Ints mask, Floats x) { return select(mask, x, Floats{}); }
SPLAT_FN Vec3<Floats> keep(Ints mask, const Vec3<Floats>& v) { return {keep(mask, v.x), keep(mask, v.y), keep(mask, v.z)}; }
SPLAT_FN Mat3<Floats> keep(Ints mask, const Mat3<Floats>& m) { return {keep(mask, m.x), keep(mask, m.y), keep(mask, m.z)}; }

// Sums each Gaussian's slots in their order, as LANES rows; returns which of the Gaussians have any. Whether a Gaussian has one
// slot or two can't be predicted, so both are read without a branch; the second one may be the next Gaussian's.
inline Ints gather_slots(const View& view, const float* slots, Group group, float* rows) {
  Ints drawn = {};
  for (int l = 0; l < LANES; l++) {
    const bool exists = l < group.count;
    const int64_t begin = exists ? view.slot_begin(group.first + l) : 0, end = exists ? view.slot_end(group.first + l) : 0;
    const float* row = slots + begin * ROW;
    const Ints one = Ints{} - int(end > begin), two = Ints{} - int(end > begin + 1);
    for (int k = 0; k < ROW; k += LANES) {
      Floats sum = keep(one, load(row + k)) + keep(two, load(row + ROW + k));
      for (int64_t i = 2; i < end - begin; i++) sum += load(row + i * ROW + k);
      store(rows + l * ROW + k, sum);
    }
    drawn[l] = begin < end ? -1 : 0;
  }
  return drawn;
}

// LANES Gaussians and their view-independent quantities.
struct Shapes {
  Gaussian<Floats> gaussians;
  Rotation<Floats> rotation;
  Mat3<Floats> axes;  // in the world

  // Members are made in place: GCC copies large objects by instructions that take long to start.
  Shapes(const Scene& scene, const SplatSettings& settings, Group group)
      : gaussians(load_gaussians(scene, settings, group)),
        rotation(quat_to_rotation(gaussians.quat)),
        axes(world_axes(rotation.matrix, gaussians.scale)) {}
};

// From one view's sums to its gradients; all zero where a Gaussian touches no tile.
SPLAT_FN ViewGradient<Floats> project_vjp(const Camera& camera, const SplatSettings& settings, const Shapes& shapes,
                                          const Floats* sums, Ints drawn) {
  const Gaussian<Floats>& g = shapes.gaussians;
  const ViewGradient<Floats> d =
      project_vjp(camera, project(camera, g.mean, shapes.axes, settings.eps2d), g.opacity, settings.antialias, sums);
  const Vec2<Floats> mean2d = {keep(drawn, d.mean2d.x), keep(drawn, d.mean2d.y)};
  return {keep(drawn, d.t), d.color, keep(drawn, d.axes), mean2d, keep(drawn, d.opacity)};
}

SPLAT_FN void add_viewmat(ViewmatSums& sum, const Shapes& shapes, const ViewGradient<Floats>& d, Ints drawn) {
  const Mat3<Floats> rotation = view_rotation_vjp(keep(drawn, shapes.gaussians.mean), keep(drawn, shapes.axes), d);
  sum.rotation = {sum.rotation.x + rotation.x, sum.rotation.y + rotation.y, sum.rotation.z + rotation.z};
  sum.translation = sum.translation + d.t;
}

SPLAT_FN void store_vec2(float* p, int count, const Vec2<Floats>& v) {
  store_items<2>(p, count, [&](float* q) { store2(q, v); });
}

SPLAT_FN void store_vec3(float* p, int count, const Vec3<Floats>& v) {
  store_items<3>(p, count, [&](float* q) { store3(q, v); });
}

SPLAT_FN void store_view(const BackwardCall& call, int view, Group group, const ViewGradient<Floats>& d, const Floats* sums) {
  const SplatGradients& out = call.out;
  const int64_t at = view * call.scene.gaussians + group.first;
  const float unscale = UNSCALE * UNSCALE;
  store_vec2(out.means2d + 2 * at, group.count, d.mean2d);
  if (out.absgrad) store_vec2(out.absgrad + 2 * at, group.count, {unscale * sums[ABS_X], unscale * sums[ABS_Y]});
  if (call.scene.colors_per_view) store_vec3(out.colors + 3 * at, group.count, d.color);
}

// Through rotation and scale; a Gaussian that isn't rendered has zero gradients, finite or not.
SPLAT_FN void store_world(const BackwardCall& call, Group group, const Shapes& shapes, const WorldGradient<Floats>& d, Ints drawn) {
  const auto [first, count] = group;
  const SplatGradients& out = call.out;
  Mat3<Floats> d_rotation;
  Vec3<Floats> d_scales;
  world_axes_vjp(shapes.rotation.matrix, shapes.gaussians.scale, d.axes, d_rotation, d_scales);
  const Vec4<Floats> q = quat_to_rotation_vjp(shapes.rotation, d_rotation);
  const Vec4<Floats> d_quats = {keep(drawn, q.w), keep(drawn, q.x), keep(drawn, q.y), keep(drawn, q.z)};
  store_vec3(out.means + 3 * first, count, d.mean);
  store_vec3(out.scales + 3 * first, count, keep(drawn, d_scales));
  store_items<4>(out.quats + 4 * first, count, [&](float* p) { store4(p, d_quats); });
  store_items<1>(out.opacities + first, count, [&](float* p) { store(p, d.opacity); });
  if (!call.scene.colors_per_view) store_vec3(out.colors + 3 * first, count, d.color);
}

// The gradients of a group in one view, added to those in the world; returns which of the Gaussians are drawn in it.
inline Ints project_view_backward(const BackwardCall& call, int index, Group group, const Shapes& shapes,
                                  std::vector<ViewmatSums>& viewmats, WorldGradient<Floats>& world) {
  const View& view = call.views[index];
  alignas(64) float rows[LANES * ROW];
  const Ints drawn = gather_slots(view, call.slots(view), group, rows);
  if (!any_lane(drawn)) {
    const Floats none[SUMS] = {};
    store_view(call, index, group, ViewGradient<Floats>{}, none);
    return drawn;
  }
  Floats sums[SUMS];
  load_columns<SUMS>([&](int l) { return rows + l * ROW; }, sums);
  const ViewGradient<Floats> d = project_vjp(view.camera, call.settings, shapes, sums, drawn);
  add_view(world, view.camera, d);
  if (!viewmats.empty()) add_viewmat(viewmats[index], shapes, d, drawn);
  store_view(call, index, group, d, sums);
  return drawn;
}

// All gradients of a group; `viewmats` holds a sum per view, or none.
inline void project_group_backward(const BackwardCall& call, Group group, std::vector<ViewmatSums>& viewmats) {
  const Shapes shapes(call.scene, call.settings, group);
  WorldGradient<Floats> world = {};
  Ints drawn = {};
  for (int v = 0; v < call.scene.views; v++) drawn |= project_view_backward(call, v, group, shapes, viewmats, world);
  store_world(call, group, shapes, world, drawn);
}

// Adds the lanes up into the first three rows of a 4x4 matrix.
inline void store_viewmat(const ViewmatSums& sum, float* matrix) {
  const Vec3<Floats>* rows[3] = {&sum.rotation.x, &sum.rotation.y, &sum.rotation.z};
  const Floats* translation[3] = {&sum.translation.x, &sum.translation.y, &sum.translation.z};
  for (int r = 0; r < 3; r++, matrix += 4)
    for (int l = 0; l < LANES; l++) {
      matrix[0] += rows[r]->x[l], matrix[1] += rows[r]->y[l], matrix[2] += rows[r]->z[l];
      matrix[3] += (*translation[r])[l];
    }
}

}  // namespace splat
