// Arrays of 2, 3 or 4 interleaved floats (x y z x y z ...) <-> one vector per component.
#pragma once

#include "lanes.h"
#include "splat_math.h"

namespace splat {

template <int C, class V> SPLAT_FN V component_of_3(V v0, V v1, V v2) {
  constexpr int N = lanes_of<V>();
  const V front = shuffle(v0, v1, [](int l) { return 3 * l + C < 2 * N ? 3 * l + C : 0; });
  return shuffle(front, v2, [](int l) { return 3 * l + C < 2 * N ? l : 3 * l + C - N; });
}

template <int C, class V> SPLAT_FN V component_of_4(V v0, V v1, V v2, V v3) {
  constexpr int N = lanes_of<V>();
  const V front = shuffle(v0, v1, [](int l) { return (4 * l + C) % (2 * N); });
  const V back = shuffle(v2, v3, [](int l) { return (4 * l + C) % (2 * N); });
  return shuffle(front, back, [](int l) { return 4 * l + C < 2 * N ? l : N + l; });
}

template <int K, class V> SPLAT_FN V part_of_2(V x, V y) {
  constexpr int N = lanes_of<V>();
  return shuffle(x, y, [](int l) { return (K * N + l) / 2 + (l % 2 ? N : 0); });
}

template <int K, class V> SPLAT_FN V part_of_3(V x, V y, V z) {
  constexpr int N = lanes_of<V>();
  const V xy = shuffle(x, y, [](int l) { return (K * N + l) / 3 + ((K * N + l) % 3 == 1 ? N : 0); });
  return shuffle(xy, z, [](int l) { return (K * N + l) % 3 == 2 ? (K * N + l) / 3 + N : l; });
}

template <int K, class V> SPLAT_FN V part_of_4(V w, V x, V y, V z) {
  constexpr int N = lanes_of<V>();
  const auto alternate = [](int l) { return (K * N + l) / 4 + (l % 2 ? N : 0); };
  const V wx = shuffle(w, x, alternate), yz = shuffle(y, z, alternate);
  return shuffle(wx, yz, [](int l) { return l % 4 < 2 ? l : N + l; });
}

template <class V = Floats> SPLAT_FN Vec3<V> load3(const float* p) {
  constexpr int N = lanes_of<V>();
  const V v0 = load<V>(p), v1 = load<V>(p + N), v2 = load<V>(p + 2 * N);
  return {component_of_3<0>(v0, v1, v2), component_of_3<1>(v0, v1, v2), component_of_3<2>(v0, v1, v2)};
}

SPLAT_FN Vec4<Floats> load4(const float* p) {
  const Floats v0 = load(p), v1 = load(p + LANES), v2 = load(p + 2 * LANES), v3 = load(p + 3 * LANES);
  return {component_of_4<0>(v0, v1, v2, v3), component_of_4<1>(v0, v1, v2, v3), component_of_4<2>(v0, v1, v2, v3),
          component_of_4<3>(v0, v1, v2, v3)};
}

SPLAT_FN void store2(float* p, const Vec2<Floats>& v) {
  store(p, part_of_2<0>(v.x, v.y));
  store(p + LANES, part_of_2<1>(v.x, v.y));
}

template <class V> SPLAT_FN void store3(float* p, const Vec3<V>& v) {
  constexpr int N = lanes_of<V>();
  store(p, part_of_3<0>(v.x, v.y, v.z));
  store(p + N, part_of_3<1>(v.x, v.y, v.z));
  store(p + 2 * N, part_of_3<2>(v.x, v.y, v.z));
}

SPLAT_FN void store4(float* p, const Vec4<Floats>& v) {
  store(p, part_of_4<0>(v.w, v.x, v.y, v.z));
  store(p + LANES, part_of_4<1>(v.w, v.x, v.y, v.z));
  store(p + 2 * LANES, part_of_4<2>(v.w, v.x, v.y, v.z));
  store(p + 3 * LANES, part_of_4<3>(v.w, v.x, v.y, v.z));
}

// `count` <= LANES items of WIDTH floats, read or written through a padded copy when the array ends inside the vector.
template <int WIDTH, class Read> SPLAT_FN auto load_items(const float* p, int count, Read read) {
  if (count == LANES) return read(p);
  alignas(64) float padded[WIDTH * LANES] = {};
  std::memcpy(padded, p, sizeof(float) * WIDTH * count);
  return read(padded);
}

template <int WIDTH, class Write> SPLAT_FN void store_items(float* p, int count, Write write) {
  if (count == LANES) return write(p);
  alignas(64) float padded[WIDTH * LANES];
  write(padded);
  std::memcpy(p, padded, sizeof(float) * WIDTH * count);
}

}  // namespace splat
