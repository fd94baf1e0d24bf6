// The last stage: background, 2x2 box and layout of the pictures; and its adjoint, the first stage of the backward pass.
#pragma once

#include "interleaved.h"
#include "tile.h"

namespace splat {

// Where one view's pictures go, or its upstream gradients come from.
template <class T> struct Layers {
  T *image, *alpha, *depth;
};

struct OutputPlan {
  Layers<float> out;
  Vec3<float> background;
  int width, height, downsample;  // of the pictures
};

template <class T> Layers<T> layers_of(T* image, T* alpha, T* depth, int64_t view, int64_t pixels) {
  return {image + 3 * pixels * view, alpha + pixels * view, depth + pixels * view};
}

inline Vec3<float> background_of(const SplatScene& scene, int view) {
  return {scene.background[3 * view], scene.background[3 * view + 1], scene.background[3 * view + 2]};
}

// Four pixels in a row: where they are in a block-ordered plane.
SPLAT_FN int quad_at(int row, int column) { return ((row / BLOCK) * BLOCKS_PER_ROW + column) * BLOCK_PIXELS + row % BLOCK * BLOCK; }

// Quad `column` of output row `row`: as rendered, or the mean of 2x2 pixels.
template <int DOWNSAMPLE> SPLAT_FN Quad fetch(const float* plane, int row, int column) {
  if constexpr (DOWNSAMPLE == 1) return load<Quad>(plane + quad_at(row, column));
  const Quad left = load<Quad>(plane + quad_at(2 * row, 2 * column)) + load<Quad>(plane + quad_at(2 * row + 1, 2 * column));
  const Quad right = load<Quad>(plane + quad_at(2 * row, 2 * column + 1)) + load<Quad>(plane + quad_at(2 * row + 1, 2 * column + 1));
  const Quad even = shuffle(left, right, [](int l) { return 2 * l; }), odd = shuffle(left, right, [](int l) { return 2 * l + 1; });
  return 0.25f * (even + odd);
}

// The adjoint of `fetch`, onto a plane that nothing else writes.
template <int DOWNSAMPLE> SPLAT_FN void spread(float* plane, int row, int column, Quad value) {
  if constexpr (DOWNSAMPLE == 1) return store(plane + quad_at(row, column), value);
  const Quad quarter = 0.25f * value;
  const Quad left = shuffle(quarter, quarter, [](int l) { return l / 2; }), right = shuffle(quarter, quarter, [](int l) { return 2 + l / 2; });
  for (int y = 2 * row; y < 2 * row + 2; y++) store(plane + quad_at(y, 2 * column), left), store(plane + quad_at(y, 2 * column + 1), right);
}

struct QuadPixels {
  Vec3<Quad> color;
  Quad alpha, depth;
};

SPLAT_FN void write_quad(const Layers<float>& out, int64_t at, int pixels, const QuadPixels& q) {
  if (pixels == 4) {
    store3(out.image + 3 * at, q.color), store(out.alpha + at, q.alpha), store(out.depth + at, q.depth);
    return;
  }
  float image[12];
  store3(image, q.color);
  std::memcpy(out.image + 3 * at, image, sizeof(float) * 3 * pixels);
  std::memcpy(out.alpha + at, &q.alpha, sizeof(float) * pixels);
  std::memcpy(out.depth + at, &q.depth, sizeof(float) * pixels);
}

SPLAT_FN QuadPixels read_quad(const Layers<const float>& in, int64_t at, int pixels) {
  if (pixels == 4) return {load3<Quad>(in.image + 3 * at), load<Quad>(in.alpha + at), load<Quad>(in.depth + at)};
  float image[12] = {};
  QuadPixels q = {};
  std::memcpy(image, in.image + 3 * at, sizeof(float) * 3 * pixels);
  std::memcpy(&q.alpha, in.alpha + at, sizeof(float) * pixels);
  std::memcpy(&q.depth, in.depth + at, sizeof(float) * pixels);
  q.color = load3<Quad>(image);
  return q;
}

// Calls visit(row, column, at, pixels) for the quads of a tile's output: `at` is the first pixel, `pixels` <= 4 lie inside.
template <class Visit> SPLAT_FN void for_each_quad(int width, int height, int downsample, const TileFrame& frame, Visit visit) {
  const int left = frame.left / downsample, top = frame.top / downsample, side = TILE / downsample;
  const int rows = std::min(side, height - top), columns = std::min(side, width - left);
  for (int row = 0; row < rows; row++)
    for (int x = 0; x < columns; x += 4) visit(row, x / 4, int64_t(top + row) * width + left + x, std::min(4, columns - x));
}

template <int DOWNSAMPLE> inline void write_tile_as(const OutputPlan& plan, const TileFrame& frame, const Planes& planes) {
  for_each_quad(plan.width, plan.height, DOWNSAMPLE, frame, [&](int row, int column, int64_t at, int pixels) {
    const Quad transmittance = fetch<DOWNSAMPLE>(planes.transmittance, row, column);
    const Vec3<Quad> color = {fetch<DOWNSAMPLE>(planes.red, row, column) + transmittance * plan.background.x,
                              fetch<DOWNSAMPLE>(planes.green, row, column) + transmittance * plan.background.y,
                              fetch<DOWNSAMPLE>(planes.blue, row, column) + transmittance * plan.background.z};
    write_quad(plan.out, at, pixels, {color, 1.0f - transmittance, fetch<DOWNSAMPLE>(planes.depth, row, column)});
  });
}

inline void write_tile(const OutputPlan& plan, const TileFrame& frame, const Planes& planes) {
  plan.downsample == 2 ? write_tile_as<2>(plan, frame, planes) : write_tile_as<1>(plan, frame, planes);
}

// d loss / d (colour, depth, alpha) per rendered pixel of a tile, block after block; zero outside of the image.
struct UpstreamPlanes {
  alignas(64) float red[TILE_PIXELS], green[TILE_PIXELS], blue[TILE_PIXELS], depth[TILE_PIXELS], alpha[TILE_PIXELS];
};

template <int DOWNSAMPLE> inline void read_tile_as(const Layers<const float>& in, int width, int height, const TileFrame& frame, UpstreamPlanes& planes) {
  for_each_quad(width, height, DOWNSAMPLE, frame, [&](int row, int column, int64_t at, int pixels) {
    const QuadPixels q = read_quad(in, at, pixels);
    spread<DOWNSAMPLE>(planes.red, row, column, q.color.x), spread<DOWNSAMPLE>(planes.green, row, column, q.color.y);
    spread<DOWNSAMPLE>(planes.blue, row, column, q.color.z), spread<DOWNSAMPLE>(planes.depth, row, column, q.depth);
    spread<DOWNSAMPLE>(planes.alpha, row, column, q.alpha);
  });
}

inline void read_tile(const Layers<const float>& in, int width, int height, int downsample, const TileFrame& frame, UpstreamPlanes& planes) {
  const bool inside = frame.left + TILE <= width * downsample && frame.top + TILE <= height * downsample;
  if (!inside) std::memset(&planes, 0, sizeof planes);
  downsample == 2 ? read_tile_as<2>(in, width, height, frame, planes) : read_tile_as<1>(in, width, height, frame, planes);
}

}  // namespace splat
