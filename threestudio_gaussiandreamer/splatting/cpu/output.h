// The last stage: background, 2x2 box and layout of the pictures; and its adjoint, the first stage of the backward pass.
#pragma once

#include "interleaved.h"
#include "tile.h"

namespace splat {

// The pictures of one view, or their upstream gradients, which may be missing; T is float or const float.
template <class T> struct Layers {
  T *image, *alpha, *depth;
  int width, height;
};

template <class T>
Layers<T> layers_of(T* image, T* alpha, T* depth, const Scene& scene, const SplatSettings& settings, int view) {
  const int width = scene.width / settings.downsample, height = scene.height / settings.downsample;
  const auto of_view = [&](T* all, int channels) { return all ? all + int64_t(width) * height * channels * view : nullptr; };
  return {of_view(image, 3), of_view(alpha, 1), of_view(depth, 1), width, height};
}

inline Vec3<float> background_of(const Scene& scene, int view) {
  const float* background = scene.background + 3 * view;
  return {background[0], background[1], background[2]};
}

// LANES adjacent pixels of a row of a block-ordered plane; `run` counts them from the left.
SPLAT_FN int run_at(int row, int run) {
  return ((row / BLOCK_HEIGHT) * BLOCKS_PER_ROW + run * (LANES / BLOCK_WIDTH)) * LANES + row % BLOCK_HEIGHT * BLOCK_WIDTH;
}

// Run `run` of output row `row`: as rendered, or the mean of 2x2 pixels.
template <int DOWNSAMPLE> SPLAT_FN Floats fetch(const float* plane, int row, int run) {
  const auto at = [&](int y, int x) { return load_quads([&](int block) { return plane + run_at(y, x) + block * LANES; }); };
  if constexpr (DOWNSAMPLE == 1) return at(row, run);
  const Floats left = at(2 * row, 2 * run) + at(2 * row + 1, 2 * run);
  const Floats right = at(2 * row, 2 * run + 1) + at(2 * row + 1, 2 * run + 1);
  const Floats even = shuffle(left, right, [](int l) { return 2 * l; });
  const Floats odd = shuffle(left, right, [](int l) { return 2 * l + 1; });
  return 0.25f * (even + odd);
}

// The adjoint of `fetch`, onto a plane that only this function writes.
template <int DOWNSAMPLE> SPLAT_FN void spread(float* plane, int row, int run, Floats value) {
  const auto put = [&](int y, int x, Floats v) {
    store_quads([&](int block) { return plane + run_at(y, x) + block * LANES; }, v);
  };
  if constexpr (DOWNSAMPLE == 1) return put(row, run, value);
  const Floats quarter = 0.25f * value;
  const Floats left = shuffle(quarter, quarter, [](int l) { return l / 2; });
  const Floats right = shuffle(quarter, quarter, [](int l) { return (LANES + l) / 2; });
  for (int y = 2 * row; y < 2 * row + 2; y++) put(y, 2 * run, left), put(y, 2 * run + 1, right);
}

struct RunPixels {
  Vec3<Floats> color;
  Floats alpha, depth;
};

// `pixels` <= LANES of them.
SPLAT_FN void write_run(const Layers<float>& out, int64_t at, int pixels, const RunPixels& p) {
  store_items<3>(out.image + 3 * at, pixels, [&](float* to) { store3(to, p.color); });
  store_items<1>(out.alpha + at, pixels, [&](float* to) { store(to, p.alpha); });
  store_items<1>(out.depth + at, pixels, [&](float* to) { store(to, p.depth); });
}

// `pixels` <= LANES, then zeros, of arrays that may be missing.
SPLAT_FN RunPixels read_run(const Layers<const float>& in, int64_t at, int pixels) {
  RunPixels p = {};
  if (in.image) p.color = load_items<3>(in.image + 3 * at, pixels, load3<Floats>);
  if (in.alpha) p.alpha = load_items<1>(in.alpha + at, pixels, load<Floats>);
  if (in.depth) p.depth = load_items<1>(in.depth + at, pixels, load<Floats>);
  return p;
}

// Calls visit(row, run, at, pixels) for the runs of a tile's output: `at` is the first pixel, `pixels` <= LANES lie inside.
template <int DOWNSAMPLE, class T, class Visit>
SPLAT_FN void for_each_run(const Layers<T>& layers, const TileFrame& frame, Visit visit) {
  const int left = frame.left / DOWNSAMPLE, top = frame.top / DOWNSAMPLE;
  const int rows = std::min(TILE_HEIGHT / DOWNSAMPLE, layers.height - top);
  const int columns = std::min(TILE_WIDTH / DOWNSAMPLE, layers.width - left);
  for (int row = 0; row < rows; row++)
    for (int x = 0; x < columns; x += LANES)
      visit(row, x / LANES, int64_t(top + row) * layers.width + left + x, std::min(LANES, columns - x));
}

template <int DOWNSAMPLE>
inline void write_tile_as(const Layers<float>& out, Vec3<float> background, const TileFrame& frame, const Planes& planes) {
  for_each_run<DOWNSAMPLE>(out, frame, [&](int row, int run, int64_t at, int pixels) {
    const Floats alpha = fetch<DOWNSAMPLE>(planes.alpha, row, run), rest = 1.0f - alpha;
    const Vec3<Floats> color = {fetch<DOWNSAMPLE>(planes.red, row, run) + rest * background.x,
                                fetch<DOWNSAMPLE>(planes.green, row, run) + rest * background.y,
                                fetch<DOWNSAMPLE>(planes.blue, row, run) + rest * background.z};
    write_run(out, at, pixels, {color, alpha, fetch<DOWNSAMPLE>(planes.depth, row, run)});
  });
}

// Asks for the cache lines of a tile's part of an array with `width` pixels of CHANNELS floats per row.
template <int CHANNELS, bool WRITE, class T>
SPLAT_FN void prefetch_rows(T* p, const TileFrame& frame, int downsample, int width, int height) {
  const int left = frame.left / downsample, top = frame.top / downsample;
  const int rows = std::min(TILE_HEIGHT / downsample, height - top);
  const int floats = CHANNELS * std::min(TILE_WIDTH / downsample, width - left);
  for (int row = 0; p && row < rows; row++)
    for (int x = 0; x < floats; x += 16) __builtin_prefetch(p + (int64_t(top + row) * width + left) * CHANNELS + x, WRITE);
}

template <bool WRITE, class T> SPLAT_FN void prefetch_tile(const Layers<T>& layers, const TileFrame& frame, int downsample) {
  prefetch_rows<3, WRITE>(layers.image, frame, downsample, layers.width, layers.height);
  prefetch_rows<1, WRITE>(layers.alpha, frame, downsample, layers.width, layers.height);
  prefetch_rows<1, WRITE>(layers.depth, frame, downsample, layers.width, layers.height);
}

inline Layers<float> pictures_of(const ForwardCall& call, int view) {
  const SplatPictures& p = call.out;
  return layers_of(p.image, p.alpha, p.depth, call.scene, call.settings, view);
}

inline Layers<const float> upstream_of(const BackwardCall& call, int view) {
  const SplatUpstream& u = call.upstream;
  return layers_of(u.image, u.alpha, u.depth, call.scene, call.settings, view);
}

inline void write_tile(const ForwardCall& call, int view, const TileFrame& frame, const Planes& planes) {
  const Layers<float> out = pictures_of(call, view);
  const Vec3<float> background = background_of(call.scene, view);
  call.settings.downsample == 2 ? write_tile_as<2>(out, background, frame, planes)
                                : write_tile_as<1>(out, background, frame, planes);
}

// d loss / d (colour, depth, alpha) per rendered pixel of a tile, block after block; zero outside of the image.
struct UpstreamPlanes {
  alignas(64) float red[TILE_PIXELS], green[TILE_PIXELS], blue[TILE_PIXELS], depth[TILE_PIXELS], alpha[TILE_PIXELS];
};

template <int DOWNSAMPLE>
inline void read_tile_as(const Layers<const float>& in, const TileFrame& frame, UpstreamPlanes& planes) {
  for_each_run<DOWNSAMPLE>(in, frame, [&](int row, int run, int64_t at, int pixels) {
    const RunPixels p = read_run(in, at, pixels);
    spread<DOWNSAMPLE>(planes.red, row, run, p.color.x), spread<DOWNSAMPLE>(planes.green, row, run, p.color.y);
    spread<DOWNSAMPLE>(planes.blue, row, run, p.color.z), spread<DOWNSAMPLE>(planes.depth, row, run, p.depth);
    spread<DOWNSAMPLE>(planes.alpha, row, run, p.alpha);
  });
}

inline void read_tile(const BackwardCall& call, int view, const TileFrame& frame, UpstreamPlanes& planes) {
  const Layers<const float> in = upstream_of(call, view);
  if (!frame.inside) std::memset(&planes, 0, sizeof planes);
  call.settings.downsample == 2 ? read_tile_as<2>(in, frame, planes) : read_tile_as<1>(in, frame, planes);
}

}  // namespace splat
