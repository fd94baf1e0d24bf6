// One Gaussian in one view, from the world to the blend and back: what the CPU and the CUDA kernels do around the blend. Generic
// in F and free of headers, as splat_math.h.
#pragma once

#include "splat_math.h"
#include "splat_scene.h"

namespace splat {

SPLAT_FN Camera make_camera(const Scene& scene, int view) {
  const float* v = scene.viewmats + 16 * view;
  const float* k = scene.Ks + 9 * view;
  const float width = scene.width, height = scene.height, margin_x = 0.15f * width / k[0], margin_y = 0.15f * height / k[4];
  Camera c;
  c.rotation = {{v[0], v[1], v[2]}, {v[4], v[5], v[6]}, {v[8], v[9], v[10]}};
  c.translation = {v[3], v[7], v[11]};
  c.focal = {k[0], k[4]};
  c.centre = {k[2], k[5]};
  c.slope_low = {-k[2] / k[0] - margin_x, -k[5] / k[4] - margin_y};
  c.slope_high = {(width - k[2]) / k[0] + margin_x, (height - k[5]) / k[4] + margin_y};
  c.size = {width, height};
  return c;
}

template <class F> struct Gaussian {
  Vec3<F> mean, scale;
  Vec4<F> quat;
  F opacity;
};

// Where alpha_min is 0, which kernels are told as 2^-100, an opacity from 0 to 2^-64 is drawn as 2^-64: no float32 image shows
// the difference, and 0, which has no logarithm, gets the gradient of alpha, d alpha / d opacity = exp(-|y|^2 / 2).
constexpr float LOG2_NO_ALPHA_MIN = -100.0f, LEAST_OPACITY = 5.421010862e-20f;

template <class F> SPLAT_FN F drawn_opacity(const F& opacity, float log2_alpha_min) {
  const F zero = {}, least = zero + (log2_alpha_min <= LOG2_NO_ALPHA_MIN ? LEAST_OPACITY : 0.0f);
  return select((opacity >= zero) & (opacity < least), least, opacity);
}

template <class F> SPLAT_FN auto all_finite(const Gaussian<F>& g, const Vec3<F>& color) {
  const Vec3<F> sum = 0.0f * g.mean + 0.0f * g.scale + 0.0f * color;
  return finite(sum.x + sum.y + sum.z + 0.0f * g.quat.w + 0.0f * g.quat.x + 0.0f * g.quat.y + 0.0f * g.quat.z +
                0.0f * g.opacity);
}

// Everything about a Gaussian in a view; the backward pass computes it again.
template <class F> struct Projection {
  Vec3<F> t;
  Mat3<F> axes;  // in camera coordinates
  Screen<F> screen;
  Whitening<F> whitening;
};

template <class F>
SPLAT_FN Projection<F> project(const Camera& camera, const Vec3<F>& mean, const Mat3<F>& axes_in_world, float eps2d) {
  const Vec3<F> t = to_camera(camera, mean);
  const Mat3<F> axes = multiply(camera.rotation, axes_in_world);
  const Screen<F> screen = to_screen(camera, t, axes);
  return {t, axes, screen, whiten(screen.u0, screen.u1, eps2d)};
}

// Where alpha >= alpha_min.
template <class F> struct Reach {
  F log2_opacity, level;  // level = log2(opacity / alpha_min)
  Vec2<F> extent;         // pixels, half the box
};

template <class F> SPLAT_FN Reach<F> reach_of(const Projection<F>& p, const F& opacity, bool antialias, float log2_alpha_min) {
  const F compensated = antialias ? opacity * p.whitening.compensation : opacity;
  const F log2_opacity = log2(maximum(compensated, F{} + 1e-37f)), level = log2_opacity - log2_alpha_min;
  return {log2_opacity, level, extents(p.whitening, level)};
}

// In front of the camera, representable, opaque enough for a pixel, and with a box that meets the image.
template <class F>
SPLAT_FN auto is_visible(const Camera& camera, const Projection<F>& p, const Reach<F>& reach, float near, float far) {
  const Whitening<F>& w = p.whitening;
  const Vec2<F>&mean = p.screen.mean, &extent = reach.extent;
  const auto in_range = (p.t.z > near) & (p.t.z < far) & (reach.level >= 0.0f);
  const auto drawable = finite(w.a) & finite(w.b) & finite(w.c) & finite(mean.x) & finite(mean.y) & (w.a > 0.0f) & (w.c > 0.0f);
  const auto in_columns = (mean.x + extent.x >= 0.0f) & (mean.x - extent.x <= camera.size.x);
  const auto in_rows = (mean.y + extent.y >= 0.0f) & (mean.y - extent.y <= camera.size.y);
  return in_range & drawable & in_columns & in_rows;
}

constexpr int SPLAT_COLUMNS = sizeof(Splat) / sizeof(float);

// The fields of a Splat, in their order.
template <class F> SPLAT_FN void splat_columns(const Projection<F>& p, const Reach<F>& reach, const Vec3<F>& color, F* columns) {
  const Whitening<F>& w = p.whitening;
  const F a = w.a * WHITENING_SCALE, b = w.b * WHITENING_SCALE, c = w.c * WHITENING_SCALE;
  const F tilt = w.xy / w.yy, slant = reach.extent.x * w.xy / w.xx;
  const F fields[SPLAT_COLUMNS] = {
      p.screen.mean.x, p.screen.mean.y, a,        b,    c,     reach.log2_opacity, p.t.z,          color.x,
      color.y,         color.z,         1.0f / a, tilt, slant, reach.extent.x,     reach.extent.y, reach.level};
  for (int i = 0; i < SPLAT_COLUMNS; i++) columns[i] = fields[i];
}

// ---- From the blend back -----------------------------------------------------------------------------------------------------

// What the backward blend hands over for a splat: sums over pixels, with u = d loss / d ln(alpha) and y in units of the scaled
// whitening. By linearity of y in the pixel they give the gradients of mean, covariance and opacity.
enum Sum { U, U_Y1, U_Y2, U_Y1_Y1, U_Y1_Y2, U_Y2_Y2, RED, GREEN, BLUE, DEPTH, ABS_X, ABS_Y, SUMS };

constexpr float UNSCALE = 1.0f / WHITENING_SCALE;

// Moments of u: sums of u x^i y^j, with x and y counted from a pixel.
template <class F> struct Moments {
  F m00, m10, m01, m20, m11, m02;
};

// Sums of u, u y and u y y' with y = (y1, y2) at that pixel plus (a x + b y, c y).
template <class F>
SPLAT_FN void whiten_moments(const Moments<F>& m, const F& a, const F& b, const F& c, const F& y1, const F& y2, F* sums) {
  const F step1 = a * m.m10 + b * m.m01, step2 = c * m.m01;
  sums[U] = m.m00;
  sums[U_Y1] = y1 * m.m00 + step1;
  sums[U_Y2] = y2 * m.m00 + step2;
  sums[U_Y1_Y1] = y1 * (sums[U_Y1] + step1) + a * (a * m.m20 + 2.0f * b * m.m11) + b * b * m.m02;
  sums[U_Y1_Y2] = y2 * sums[U_Y1] + y1 * step2 + c * (a * m.m11 + b * m.m02);
  sums[U_Y2_Y2] = y2 * (sums[U_Y2] + step2) + c * c * m.m02;
}

// One view's gradients of a Gaussian.
template <class F> struct ViewGradient {
  Vec3<F> t, color;
  Mat3<F> axes;  // in camera coordinates
  Vec2<F> mean2d;
  F opacity;
};

template <class F> SPLAT_FN Vec2<F> mean2d_gradient(const Whitening<F>& w, const F* sums) {
  return {UNSCALE * (w.a * sums[U_Y1]), UNSCALE * (w.b * sums[U_Y1] + w.c * sums[U_Y2])};
}

// Gradients of the rows of U; with the compensation, sums[U] also counts.
template <class F>
SPLAT_FN void footprint_gradient(const Projection<F>& p, const F* sums, bool antialias, Vec3<F>& d_u0, Vec3<F>& d_u1) {
  const Whitening<F>& w = p.whitening;
  const float unscale = UNSCALE * UNSCALE;
  const F xx = unscale * sums[U_Y1_Y1], xy = unscale * sums[U_Y1_Y2], yy = unscale * sums[U_Y2_Y2];
  whiten_vjp(w, p.screen.u0, xx, xy, yy, d_u0, d_u1);
  if (antialias) compensation_vjp(w, p.screen.u0, sums[U], d_u0, d_u1);
}

// From a splat's sums to the gradients of the Gaussian in its view.
template <class F>
SPLAT_FN ViewGradient<F> project_vjp(const Camera& camera, const Projection<F>& p, const F& opacity, bool antialias, const F* sums) {
  ViewGradient<F> d;
  Vec3<F> d_u0, d_u1;
  d.mean2d = mean2d_gradient(p.whitening, sums);
  footprint_gradient(p, sums, antialias, d_u0, d_u1);
  to_screen_vjp(camera, p.screen, p.axes, d.mean2d, sums[DEPTH], d_u0, d_u1, d.t, d.axes);
  d.opacity = sums[U] / opacity, d.color = {sums[RED], sums[GREEN], sums[BLUE]};
  return d;
}

// A Gaussian's gradients, added up over the views.
template <class F> struct WorldGradient {
  Vec3<F> mean, color;
  Mat3<F> axes;  // in the world
  F opacity;
};

template <class F> SPLAT_FN void add_view(WorldGradient<F>& sum, const Camera& camera, const ViewGradient<F>& d) {
  const Mat3<F> d_axes = multiply_transposed(camera.rotation, d.axes);
  sum.axes = {sum.axes.x + d_axes.x, sum.axes.y + d_axes.y, sum.axes.z + d_axes.z};
  sum.mean = sum.mean + to_camera_vjp(camera, d.t);
  sum.color = sum.color + d.color;
  sum.opacity += d.opacity;
}

// d loss / d rotation of a viewmat, of which d.t is d loss / d translation: t = R mean + T and axes = R axes_in_world.
template <class F> SPLAT_FN Mat3<F> view_rotation_vjp(const Vec3<F>& mean, const Mat3<F>& axes, const ViewGradient<F>& d) {
  const auto row = [&](const F& d_t, const Vec3<F>& d_axis) {
    return Vec3<F>{d_t * mean.x + dot(d_axis, axes.x), d_t * mean.y + dot(d_axis, axes.y), d_t * mean.z + dot(d_axis, axes.z)};
  };
  return {row(d.t.x, d.axes.x), row(d.t.y, d.axes.y), row(d.t.z, d.axes.z)};
}

}  // namespace splat
