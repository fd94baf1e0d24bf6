// The formulas of the image model, each written once and beside its vector-Jacobian product (`f` and `f_vjp`).
//
// Generic in F: `float` (one Gaussian or pixel per thread) or a SIMD vector of floats (one per lane). No standard header is
// needed, so CUDA source can include this file too; `SPLAT_FN` carries its function qualifiers. Vectors need the overloads
// of `square_root` and `log2` declared before this file is included, and one of `exp2`.
//
// The image model is EWA splatting (Zwicker et al. 2001) as in 3D Gaussian Splatting (Kerbl et al. 2023): a Gaussian whose
// mean is t in camera coordinates becomes a 2-D Gaussian with covariance J W S W' J' + eps I. In place of that covariance
// and its inverse, which cancel in float32, everything here uses its factors: U, the 2x3 matrix J W S^(1/2), and the
// whitening P with P' P = (U U' + eps I)^-1.
#pragma once

#ifndef SPLAT_FN
#define SPLAT_FN static inline
#endif

namespace splat {

template <class M, class F> SPLAT_FN F select(M mask, F a, F b) { return mask ? a : b; }
template <class F> SPLAT_FN F minimum(F a, F b) { return a < b ? a : b; }
template <class F> SPLAT_FN F maximum(F a, F b) { return a > b ? a : b; }
#ifdef __CUDACC__
SPLAT_FN float square_root(float x) { return sqrtf(x); }
SPLAT_FN float exp2(float x) { return exp2f(x); }
SPLAT_FN float log2(float x) { return log2f(x); }
#else
SPLAT_FN float square_root(float x) { return __builtin_sqrtf(x); }
SPLAT_FN float exp2(float x) { return __builtin_exp2f(x); }
SPLAT_FN float log2(float x) { return __builtin_log2f(x); }
#endif

template <class F> SPLAT_FN F clamp(F x, F low, F high) { return minimum(maximum(x, low), high); }
template <class F> SPLAT_FN auto finite(F x) { return x * 0.0f == 0.0f; }

template <class F> struct Vec2 {
  F x, y;
};
template <class F> struct Vec3 {
  F x, y, z;
};
template <class F> struct Vec4 {
  F w, x, y, z;
};
template <class F> struct Mat3 {
  Vec3<F> x, y, z;
};  // rows

template <class F> SPLAT_FN Vec3<F> operator+(const Vec3<F>& a, const Vec3<F>& b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
template <class F> SPLAT_FN Vec3<F> operator-(const Vec3<F>& a, const Vec3<F>& b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
template <class A, class F> SPLAT_FN Vec3<F> operator*(A s, const Vec3<F>& v) { return {s * v.x, s * v.y, s * v.z}; }
template <class A, class F> SPLAT_FN F dot(const Vec3<A>& a, const Vec3<F>& b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
template <class F> SPLAT_FN Vec3<F> cross(const Vec3<F>& a, const Vec3<F>& b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
template <class A, class F> SPLAT_FN Mat3<F> multiply(const Mat3<A>& a, const Mat3<F>& b) {
  return {a.x.x * b.x + a.x.y * b.y + a.x.z * b.z, a.y.x * b.x + a.y.y * b.y + a.y.z * b.z,
          a.z.x * b.x + a.z.y * b.y + a.z.z * b.z};
}
template <class A, class F> SPLAT_FN Mat3<F> multiply_transposed(const Mat3<A>& a, const Mat3<F>& b) {  // a' b
  return {a.x.x * b.x + a.y.x * b.y + a.z.x * b.z, a.x.y * b.x + a.y.y * b.y + a.z.y * b.z,
          a.x.z * b.x + a.y.z * b.y + a.z.z * b.z};
}
template <class A, class F> SPLAT_FN Vec3<F> multiply_transposed(const Mat3<A>& a, const Vec3<F>& v) {  // a' v
  return {a.x.x * v.x + a.y.x * v.y + a.z.x * v.z, a.x.y * v.x + a.y.y * v.y + a.z.y * v.z,
          a.x.z * v.x + a.y.z * v.y + a.z.z * v.z};
}

// ---- Gaussians in the world ------------------------------------------------------------------------------------------------

template <class F> struct Rotation {
  Vec4<F> unit;
  F inverse_norm;  // 0 for the identity that stands in for a zero quaternion, which so gets a zero gradient
  Mat3<F> matrix;
};

// Rotation of a quaternion of any length; below 1e-12 the identity. Dividing by the largest entry first keeps the squares of
// tiny and huge quaternions inside float32.
template <class F> SPLAT_FN Rotation<F> quat_to_rotation(const Vec4<F>& q) {
  const F zero = {}, one = zero + 1.0f;
  const F largest = maximum(maximum(maximum(q.w, -q.w), maximum(q.x, -q.x)), maximum(maximum(q.y, -q.y), maximum(q.z, -q.z)));
  const auto usable = largest >= zero + 1e-12f;
  const F shrink = 1.0f / select(usable, largest, one);
  const F w = select(usable, q.w * shrink, one), x = select(usable, q.x * shrink, zero);
  const F y = select(usable, q.y * shrink, zero), z = select(usable, q.z * shrink, zero);
  const F inverse = 1.0f / square_root(w * w + x * x + y * y + z * z);
  const Vec4<F> n = {w * inverse, x * inverse, y * inverse, z * inverse};
  const Mat3<F> matrix = {
      {1.0f - 2.0f * (n.y * n.y + n.z * n.z), 2.0f * (n.x * n.y - n.w * n.z), 2.0f * (n.x * n.z + n.w * n.y)},
      {2.0f * (n.x * n.y + n.w * n.z), 1.0f - 2.0f * (n.x * n.x + n.z * n.z), 2.0f * (n.y * n.z - n.w * n.x)},
      {2.0f * (n.x * n.z - n.w * n.y), 2.0f * (n.y * n.z + n.w * n.x), 1.0f - 2.0f * (n.x * n.x + n.y * n.y)}};
  return {n, select(usable, inverse * shrink, zero), matrix};
}

template <class F> SPLAT_FN Vec4<F> quat_to_rotation_vjp(const Rotation<F>& rotation, const Mat3<F>& d) {
  const Vec4<F>& q = rotation.unit;
  const Vec4<F> unit = {
      2.0f * (q.x * (d.z.y - d.y.z) + q.y * (d.x.z - d.z.x) + q.z * (d.y.x - d.x.y)),
      2.0f * (q.y * (d.x.y + d.y.x) + q.z * (d.x.z + d.z.x) + q.w * (d.z.y - d.y.z) - 2.0f * q.x * (d.y.y + d.z.z)),
      2.0f * (q.x * (d.x.y + d.y.x) + q.z * (d.y.z + d.z.y) + q.w * (d.x.z - d.z.x) - 2.0f * q.y * (d.x.x + d.z.z)),
      2.0f * (q.x * (d.x.z + d.z.x) + q.y * (d.y.z + d.z.y) + q.w * (d.y.x - d.x.y) - 2.0f * q.z * (d.x.x + d.y.y))};
  const F radial = q.w * unit.w + q.x * unit.x + q.y * unit.y + q.z * unit.z;
  const F s = rotation.inverse_norm;
  return {s * (unit.w - radial * q.w), s * (unit.x - radial * q.x), s * (unit.y - radial * q.y), s * (unit.z - radial * q.z)};
}

// Columns are the Gaussian's three axes in the world, as long as its standard deviations: R diag(scale).
template <class F> SPLAT_FN Mat3<F> world_axes(const Mat3<F>& rotation, const Vec3<F>& scale) {
  const Mat3<F>& r = rotation;
  return {{r.x.x * scale.x, r.x.y * scale.y, r.x.z * scale.z},
          {r.y.x * scale.x, r.y.y * scale.y, r.y.z * scale.z},
          {r.z.x * scale.x, r.z.y * scale.y, r.z.z * scale.z}};
}

template <class F>
SPLAT_FN void world_axes_vjp(const Mat3<F>& rotation, const Vec3<F>& scale, const Mat3<F>& d, Mat3<F>& d_rotation,
                             Vec3<F>& d_scale) {
  const Mat3<F>& r = rotation;
  d_rotation = world_axes(d, scale);
  d_scale = {r.x.x * d.x.x + r.y.x * d.y.x + r.z.x * d.z.x, r.x.y * d.x.y + r.y.y * d.y.y + r.z.y * d.z.y,
             r.x.z * d.x.z + r.y.z * d.y.z + r.z.z * d.z.z};
}

// ---- Gaussians on the screen -----------------------------------------------------------------------------------------------

// OpenCV camera: x right, y down, z forward; pixel centres at +0.5. Outside of the slopes (x/z, y/z) the pinhole isn't
// linearised further: they are the image widened by 30 % of half the field of view.
struct Camera {
  Mat3<float> rotation;  // world to camera
  Vec3<float> translation;
  Vec2<float> focal, centre, slope_low, slope_high, size;  // pixels, but for the slopes
};

template <class F> SPLAT_FN Vec3<F> to_camera(const Camera& camera, const Vec3<F>& mean) {
  return {dot(camera.rotation.x, mean) + camera.translation.x, dot(camera.rotation.y, mean) + camera.translation.y,
          dot(camera.rotation.z, mean) + camera.translation.z};
}

template <class F> SPLAT_FN Vec3<F> to_camera_vjp(const Camera& camera, const Vec3<F>& d_t) {
  return multiply_transposed(camera.rotation, d_t);
}

template <class F> struct Screen {
  F inverse_depth;
  Vec2<F> ray, slope;  // t.xy / t.z, free and clamped
  Vec2<F> mean;        // pixels
  Vec3<F> u0, u1;      // rows of U: d(pixel x) and d(pixel y) along each axis
};

// Pinhole of the mean t and, linearised there, of the axes (columns, camera coordinates).
template <class F> SPLAT_FN Screen<F> to_screen(const Camera& camera, const Vec3<F>& t, const Mat3<F>& axes) {
  const F zero = {}, inverse = 1.0f / t.z;
  const Vec2<F> ray = {t.x * inverse, t.y * inverse};
  const Vec2<F> slope = {clamp(ray.x, zero + camera.slope_low.x, zero + camera.slope_high.x),
                         clamp(ray.y, zero + camera.slope_low.y, zero + camera.slope_high.y)};
  const Vec2<F> mean = {camera.focal.x * ray.x + camera.centre.x, camera.focal.y * ray.y + camera.centre.y};
  return {inverse,
          ray,
          slope,
          mean,
          (camera.focal.x * inverse) * (axes.x - slope.x * axes.z),
          (camera.focal.y * inverse) * (axes.y - slope.y * axes.z)};
}

// Gradients of t and the axes; d_depth is that of t.z itself. The clamped slope is constant, the focal / z before it isn't.
template <class F>
SPLAT_FN void to_screen_vjp(const Camera& camera, const Screen<F>& s, const Mat3<F>& axes, const Vec2<F>& d_mean,
                            const F& d_depth, const Vec3<F>& d_u0, const Vec3<F>& d_u1, Vec3<F>& d_t, Mat3<F>& d_axes) {
  const F zero = {};
  d_axes.x = (camera.focal.x * s.inverse_depth) * d_u0;
  d_axes.y = (camera.focal.y * s.inverse_depth) * d_u1;
  d_axes.z = (-s.slope.x) * d_axes.x - s.slope.y * d_axes.y;
  const F d_ray_x = camera.focal.x * d_mean.x - select(s.slope.x == s.ray.x, dot(d_axes.x, axes.z), zero);
  const F d_ray_y = camera.focal.y * d_mean.y - select(s.slope.y == s.ray.y, dot(d_axes.y, axes.z), zero);
  const F d_log_depth = d_ray_x * s.ray.x + d_ray_y * s.ray.y + dot(d_u0, s.u0) + dot(d_u1, s.u1);
  d_t = {d_ray_x * s.inverse_depth, d_ray_y * s.inverse_depth, d_depth - d_log_depth * s.inverse_depth};
}

// y = P d = (a d.x + b d.y, c d.y) turns the splat into the unit Gaussian exp(-|y|^2 / 2). It is the completed square of
// d' cov^-1 d: unlike the entries of cov^-1 it doesn't cancel for a needle.
template <class F> struct Whitening {
  F a, b, c;
  F xx, xy, yy;  // cov
  Vec3<F> v, n;  // u1 / sqrt(yy), u0 x v
  F area;        // |n|^2
  F compensation;
  F rest;  // 1 - |v|^2 = eps / yy
};

// By Lagrange's identity det(U U') = |u0 x u1|^2, so det(cov) / yy = |n|^2 + eps (1 + |u0|^2 / yy): a sum of squares, which
// can neither cancel nor go negative. The compensation sqrt(det before / det after the dilation) keeps a splat's energy.
template <class F> SPLAT_FN Whitening<F> whiten(const Vec3<F>& u0, const Vec3<F>& u1, float eps) {
  const F xx = dot(u0, u0), yy = dot(u1, u1) + eps, xy = dot(u0, u1);
  const F c = 1.0f / square_root(yy);
  const Vec3<F> v = c * u1, n = cross(u0, v);
  const F area = dot(n, n);
  const F a = 1.0f / square_root(area + eps * (1.0f + xx * c * c));
  return {a, -a * (xy * c * c), c, xx + eps, xy, yy, v, n, area, square_root(area) * a, eps * c * c};
}

// From M = sum of u y y' over the pixels, where u = d loss / d ln(alpha): d loss / d cov = P' M P / 2 and
// d loss / d U = P' M P U. The first row of P U, a (u0 - (xy / yy) u1), cancels for a needle; by v x (u0 x v) =
// |v|^2 u0 - (u0 v) v it is a (v x n + (1 - |v|^2) u0), which doesn't.
template <class F>
SPLAT_FN void whiten_vjp(const Whitening<F>& w, const Vec3<F>& u0, const F& m_xx, const F& m_xy, const F& m_yy, Vec3<F>& d_u0,
                         Vec3<F>& d_u1) {
  const Vec3<F> p0 = w.a * (cross(w.v, w.n) + w.rest * u0), &p1 = w.v;
  const Vec3<F> q0 = m_xx * p0 + m_xy * p1, q1 = m_xy * p0 + m_yy * p1;
  d_u0 = w.a * q0;
  d_u1 = w.b * q0 + w.c * q1;
}

// What the compensation adds. Its log has the derivative ((U U')^-1 - (U U' + eps I)^-1) U = eps P' P (U U')^-1 U, which unlike
// that difference doesn't cancel for a Gaussian of many pixels; `total` is the sum of u.
template <class F>
SPLAT_FN void compensation_vjp(const Whitening<F>& w, const Vec3<F>& u0, const F& total, Vec3<F>& d_u0, Vec3<F>& d_u1) {
  const F zero = {}, scale = select(w.area > zero, total * w.rest * w.yy / w.area, zero);
  const Vec3<F> g0 = scale * cross(w.v, w.n), g1 = (scale * w.c) * cross(w.n, u0);
  const Vec3<F> p0 = w.a * g0 + w.b * g1, p1 = w.c * g1;
  d_u0 = d_u0 + w.a * p0;
  d_u1 = d_u1 + w.b * p0 + w.c * p1;
}

// Half the sides of the box around alpha >= alpha_min, in pixels; `level` is log2(opacity / alpha_min).
template <class F> SPLAT_FN Vec2<F> extents(const Whitening<F>& w, F level) {
  const F q = maximum(level, F{}) * 1.3862943611f;  // 2 ln 2
  return {square_root(q * w.xx), square_root(q * w.yy)};
}

// ---- Splats in pixels ------------------------------------------------------------------------------------------------------

// In pixels the whitening is scaled by sqrt(log2(e) / 2), so that log2(alpha) = log2(opacity) - |y|^2.
constexpr float WHITENING_SCALE = 0.84932180028801904f;

// One Gaussian in one view, a cache line.
struct alignas(64) Splat {
  float x, y;  // mean, pixels
  float a, b, c, log2_opacity;
  float depth, red, green, blue;
  float inverse_a, tilt;     // x of the ellipse's widest row moves by tilt = -b / a per y
  float slant;               // y of the ellipse's rightmost point above the mean
  float extent_x, extent_y;  // pixels
  float level;               // log2(opacity / alpha_min) = |y|^2 on the ellipse's rim
};

// The rim of a splat, where alpha = alpha_min, around (x, y).
template <class F> struct Ellipse {
  F x, y, extent_y;
  F c2, level;  // |y|^2 <= level inside; c2 = c * c
  F inverse_a, tilt, slant;
};

template <class F> struct Span {
  F low, high;
};

// Columns of the ellipse inside the rows y_low <= y <= y_high; meaningless when they miss it. Its right side bulges most at
// `slant` above the centre, its left side as far below.
template <class F> SPLAT_FN Span<F> row_span(const Ellipse<F>& e, F y_low, F y_high) {
  const F zero = {}, right = clamp(e.slant, y_low - e.y, y_high - e.y), left = clamp(-e.slant, y_low - e.y, y_high - e.y);
  const F half_right = square_root(maximum(e.level - e.c2 * right * right, zero)) * e.inverse_a;
  const F half_left = square_root(maximum(e.level - e.c2 * left * left, zero)) * e.inverse_a;
  return {e.x + (e.tilt * left - half_left), e.x + (e.tilt * right + half_right)};
}

template <class F> SPLAT_FN auto meets_rows(const Ellipse<F>& e, F y_low, F y_high) {
  return (y_low - e.y <= e.extent_y) & (y_high - e.y >= -e.extent_y);
}

// alpha = min(alpha_max, 2^power), zero below alpha_min.
template <class F> SPLAT_FN F alpha_of(F power, float log2_alpha_min, float alpha_max) {
  const F zero = {};
  return select(power >= zero + log2_alpha_min, minimum(exp2(power), F(zero + alpha_max)), zero);
}

// Front-to-back compositing of one splat with transmittance T before it: it counts while T >= stop, so the one that brings
// T below `stop` is the last.
template <class F> SPLAT_FN F weight_of(F alpha, F transmittance, float stop) {
  const F zero = {};
  return select(transmittance >= zero + stop, alpha * transmittance, zero);
}

// d loss / d ln(alpha) front to back, zero where the cap holds or the pixel has stopped. `odds` is alpha / (1 - alpha),
// `value` is d loss / d weight, `behind` is the sum of weight * value over everything behind, background included.
template <class F>
SPLAT_FN F blend_vjp(F alpha, F odds, F transmittance, F weight, F value, F behind, float alpha_max, float stop) {
  const F zero = {}, u = weight * value - behind * odds;
  return select((alpha < zero + alpha_max) & (transmittance >= zero + stop), u, zero);
}

// The same back to front, for an alpha that is zero where the pixel has stopped. `value_behind` is the value of what lies behind
// the splat, seen without what lies before it; it becomes the value behind the splat before.
template <class F> SPLAT_FN F blend_vjp_back_to_front(F alpha, F weight, F value, float alpha_max, F& value_behind) {
  const F zero = {}, u = select(alpha < zero + alpha_max, weight * (value - value_behind), zero);
  value_behind = (1.0f - alpha) * value_behind + alpha * value;  // one operation waits for the splat behind
  return u;
}

}  // namespace splat
