// SIMD vectors by GCC's vector extensions: as many lanes as the instruction set of this build has.
#pragma once

#include <cstdint>
#include <cstring>
#include <utility>

#if defined(__AVX2__)
#include <immintrin.h>
#endif

#define SPLAT_FN static inline __attribute__((always_inline))

namespace splat {

#if defined(__AVX512F__)
constexpr int LANES = 16;
#elif defined(__AVX2__)
constexpr int LANES = 8;
#else
constexpr int LANES = 4;
#endif

template <int N> struct Vector {
  typedef float Float __attribute__((vector_size(4 * N)));
  typedef int32_t Int __attribute__((vector_size(4 * N)));
  typedef uint32_t Unsigned __attribute__((vector_size(4 * N)));
};
using Floats = Vector<LANES>::Float;
using Ints = Vector<LANES>::Int;

template <class V> constexpr int lanes_of() { return sizeof(V) / 4; }

template <class V = Floats> SPLAT_FN V load(const float* p) {
  V v;
  std::memcpy(&v, p, sizeof v);
  return v;
}
template <class V> SPLAT_FN void store(float* p, V v) { std::memcpy(p, &v, sizeof v); }

// Copies whole vectors past the caches, for memory that is read much later; `to` and `from` are aligned to vectors. Other threads
// see it after `end_streams`.
SPLAT_FN void stream(float* to, const float* from, int count) {
  for (int i = 0; i < count; i += LANES) {
#if defined(__AVX512F__)
    _mm512_stream_ps(to + i, (__m512)load(from + i));
#elif defined(__AVX2__)
    _mm256_stream_ps(to + i, (__m256)load(from + i));
#else
    store(to + i, load(from + i));
#endif
  }
}

SPLAT_FN void end_streams() {
#if defined(__AVX2__)
  _mm_sfence();
#endif
}

// Lane l of the result is lane `pattern(l)` of a and b laid end to end; `pattern` is a captureless lambda.
template <class V, class Pattern, int... L> SPLAT_FN V shuffle(V a, V b, Pattern pattern, std::integer_sequence<int, L...>) {
#if defined(__clang__)
  return __builtin_shufflevector(a, b, pattern(L)...);
#else
  return __builtin_shuffle(a, b, typename Vector<lanes_of<V>()>::Int{pattern(L)...});
#endif
}
template <class V, class Pattern> SPLAT_FN V shuffle(V a, V b, Pattern pattern) {
  return shuffle(a, b, pattern, std::make_integer_sequence<int, lanes_of<V>()>());
}

template <class V> SPLAT_FN V square_root(V x) {
  for (int l = 0; l < lanes_of<V>(); l++) x[l] = __builtin_sqrtf(x[l]);
  return x;
}

#if defined(__AVX512F__)
// As the generic ones in splat_math.h, which GCC 12 turns into a comparison and a blend where there are mask registers.
SPLAT_FN Floats minimum(Floats a, Floats b) { return (Floats)_mm512_maskz_min_ps(0xffff, (__m512)a, (__m512)b); }
SPLAT_FN Floats maximum(Floats a, Floats b) { return (Floats)_mm512_maskz_max_ps(0xffff, (__m512)a, (__m512)b); }
#endif

// Whether x >= bound in any lane.
SPLAT_FN bool any_at_least(Floats x, float bound) {
#if defined(__AVX512F__)
  return _mm512_cmp_ps_mask((__m512)x, _mm512_set1_ps(bound), _CMP_GE_OQ) != 0;
#elif defined(__AVX2__)
  return _mm256_movemask_ps((__m256)(x >= bound)) != 0;
#else
  Ints any = x >= bound;
  any |= shuffle(any, any, [](int l) { return (l + 2) % LANES; });
  return (any[0] | any[1]) != 0;
#endif
}

SPLAT_FN Ints load_ints(const uint32_t* p) {
  Ints v;
  std::memcpy(&v, p, sizeof v);
  return v;
}
SPLAT_FN void store_ints(uint32_t* p, Ints v) { std::memcpy(p, &v, sizeof v); }

// The lower halves of the lanes.
SPLAT_FN void store_halves(uint16_t* p, Ints v) {
#if defined(__AVX512F__)
  _mm256_storeu_si256(reinterpret_cast<__m256i*>(p), _mm512_cvtepi32_epi16((__m512i)v));
#else
  typedef uint16_t Halves __attribute__((vector_size(2 * LANES)));
  const Halves halves = __builtin_convertvector(v, Halves);
  std::memcpy(p, &halves, sizeof halves);
#endif
}

SPLAT_FN Ints lane_numbers() {
  Ints lanes;
  for (int l = 0; l < LANES; l++) lanes[l] = l;
  return lanes;
}

// Some of the lanes, a bit for each.
struct Choice {
#if defined(__AVX512F__)
  __mmask16 lanes;
#else
  int lanes;
#endif

  int count() const { return __builtin_popcount(lanes); }
};

#if defined(__AVX512F__)
SPLAT_FN Choice with_any_bit(Ints x, uint32_t bits) { return {_mm512_test_epi32_mask((__m512i)x, _mm512_set1_epi32(int(bits)))}; }
SPLAT_FN Choice with_bit(Ints x, int bit) { return with_any_bit(x, 1u << bit); }

// The chosen lanes one after the other; what follows them is not specified.
SPLAT_FN Ints to_front(Choice chosen, Ints x) { return (Ints)_mm512_maskz_compress_epi32(chosen.lanes, (__m512i)x); }
#else
SPLAT_FN Choice negative(Ints x) {
#if defined(__AVX2__)
  return {_mm256_movemask_ps((__m256)x)};
#else
  int lanes = 0;
  for (int l = 0; l < LANES; l++) lanes |= (x[l] < 0) << l;
  return {lanes};
#endif
}

SPLAT_FN Choice with_any_bit(Ints x, uint32_t bits) { return negative((x & int(bits)) != 0); }
SPLAT_FN Choice with_bit(Ints x, int bit) { return negative(x << (31 - bit)); }

// The positions of the bits of each byte, low to high.
struct BitPositions {
  uint8_t of[256][8] = {};
  constexpr BitPositions() {
    for (int byte = 0; byte < 256; byte++)
      for (int bit = 0, count = 0; bit < 8; bit++)
        if (byte >> bit & 1) of[byte][count++] = uint8_t(bit);
  }
};
constexpr BitPositions BIT_POSITIONS;

SPLAT_FN Ints to_front(Choice chosen, Ints x) {
  const uint8_t* positions = BIT_POSITIONS.of[chosen.lanes];
#if defined(__AVX2__)
  const __m256i order = _mm256_cvtepu8_epi32(_mm_loadl_epi64(reinterpret_cast<const __m128i*>(positions)));
  return (Ints)_mm256_permutevar8x32_epi32((__m256i)x, order);
#else
  Ints front;
  for (int l = 0; l < LANES; l++) front[l] = x[positions[l]];
  return front;
#endif
}
#endif

// Whether a mask is set in any lane.
SPLAT_FN bool any_lane(Ints mask) { return with_bit(mask, 31).lanes != 0; }

// log2(x) of a normal x > 0, relative error 2e-7: exponent + 2 atanh((m - 1) / (m + 1)) / ln 2 with m in [sqrt(1/2), sqrt(2)).
SPLAT_FN Floats log2(Floats x) {
  const Ints shifted = (Ints)x - 0x3f3504f3;  // the bits of sqrt(1/2)
  const Ints exponent = shifted >> 23;
  const Floats m = (Floats)((Ints)x - (exponent << 23));
  const Floats s = (m - 1.0f) / (m + 1.0f), s2 = s * s;
  Floats y = 0.32059890f * s2 + 0.41219858f;
  y = y * s2 + 0.57707802f;
  y = y * s2 + 0.96179669f;
  y = y * s2 + 2.88539008f;
  return y * s + __builtin_convertvector(exponent, Floats);
}

// ---- rows of memory <-> lanes ----------------------------------------------------------------------------------------------

// Transposes each 4x4 square of four vectors.
template <class V> SPLAT_FN void transpose_quads(V& r0, V& r1, V& r2, V& r3) {
  constexpr int N = lanes_of<V>();
  const auto low = [](int l) { return (l & ~3) + ((l & 3) >> 1) + (l & 1) * N; };
  const auto high = [](int l) { return (l & ~3) + 2 + ((l & 3) >> 1) + (l & 1) * N; };
  const auto front = [](int l) { return (l & ~3) + (l & 1) + ((l & 2) >> 1) * N; };
  const auto back = [](int l) { return (l & ~3) + 2 + (l & 1) + ((l & 2) >> 1) * N; };
  const V t0 = shuffle(r0, r1, low), t1 = shuffle(r2, r3, low), t2 = shuffle(r0, r1, high), t3 = shuffle(r2, r3, high);
  r0 = shuffle(t0, t1, front), r1 = shuffle(t0, t1, back), r2 = shuffle(t2, t3, front), r3 = shuffle(t2, t3, back);
}

// Transposes the LANES x LANES square in place.
SPLAT_FN void transpose(Floats r[LANES]) {
  for (int i = 0; i < LANES; i += 4) transpose_quads(r[i], r[i + 1], r[i + 2], r[i + 3]);
  const auto even = [](int l) { return (l & 3) + 8 * (l >> 2); };  // 128-bit groups 0, 2 of a, then of b
  const auto odd = [](int l) { return (l & 3) + 8 * (l >> 2) + 4; };
  if constexpr (LANES == 8) {
    const auto first = [](int l) { return l < 4 ? l : l + 4; };
    const auto second = [](int l) { return l < 4 ? l + 4 : l + 8; };
    for (int k = 0; k < 4; k++) {
      const Floats a = r[k], b = r[4 + k];
      r[k] = shuffle(a, b, first), r[4 + k] = shuffle(a, b, second);
    }
  }
  if constexpr (LANES == 16) {
    for (int k = 0; k < 4; k++) {
      const Floats a = shuffle(r[k], r[4 + k], even), b = shuffle(r[k], r[4 + k], odd);
      const Floats c = shuffle(r[8 + k], r[12 + k], even), d = shuffle(r[8 + k], r[12 + k], odd);
      r[k] = shuffle(a, c, even), r[8 + k] = shuffle(a, c, odd);
      r[4 + k] = shuffle(b, d, even), r[12 + k] = shuffle(b, d, odd);
    }
  }
}

// LANES / 4 groups of four floats, where group g starts at `group(g)`.
template <class Group> SPLAT_FN Floats load_quads(Group group) {
#if defined(__AVX512F__)
  __m512 v = _mm512_castps128_ps512(_mm_loadu_ps(group(0)));
  v = _mm512_insertf32x4(v, _mm_loadu_ps(group(1)), 1);
  v = _mm512_insertf32x4(v, _mm_loadu_ps(group(2)), 2);
  return (Floats)_mm512_insertf32x4(v, _mm_loadu_ps(group(3)), 3);
#elif defined(__AVX2__)
  return (Floats)_mm256_insertf128_ps(_mm256_castps128_ps256(_mm_loadu_ps(group(0))), _mm_loadu_ps(group(1)), 1);
#else
  return load(group(0));
#endif
}

template <class Group> SPLAT_FN void store_quads(Group group, Floats v) {
  for (int g = 0; g < LANES / 4; g++) std::memcpy(group(g), reinterpret_cast<const float*>(&v) + 4 * g, 4 * sizeof(float));
}

constexpr int ROW = 16;  // floats in a cache line; the rows below

// Columns 0 .. COUNT - 1 of LANES rows, where row l starts at `row(l)`; COUNT is a multiple of 4. Loading four floats at a time
// saves half of the shuffles of `transpose`.
template <int COUNT, class Row> SPLAT_FN void load_columns(Row row, Floats* columns) {
  for (int c = 0; c < COUNT; c += 4) {
    for (int i = 0; i < 4; i++) columns[c + i] = load_quads([&](int group) { return row(4 * group + i) + c; });
    transpose_quads(columns[c], columns[c + 1], columns[c + 2], columns[c + 3]);
  }
}

// The 16 columns as LANES rows one after the other.
SPLAT_FN void store_columns(Floats columns[ROW], float* rows) {
  for (int first = 0; first < ROW; first += LANES) {
    transpose(columns + first);
    for (int l = 0; l < LANES; l++) store(rows + l * ROW + first, columns[first + l]);
  }
}

}  // namespace splat
