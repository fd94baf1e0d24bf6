// Which tiles, and which patches of a tile, an ellipse overlaps. All tests are exact but for a margin that covers rounding:
// the blend tests each pixel, so an additional patch only costs time.
#pragma once

#include "launch.h"

namespace splat {

SPLAT_FN float margin_of(float centre, float extent) { return 1e-3f + 1e-6f * (fabsf(centre) + extent); }

struct Range {
  int begin, end;
};

// Cells of `size` pixels, `count` in all, that hold a pixel centre within [low, high].
SPLAT_FN Range cells(float low, float high, float size, int count) {
  const float limit = float(count);
  return {int(clamp(ceilf((low + 0.5f) / size - 1.0f), 0.0f, limit)), int(clamp(floorf((high - 0.5f) / size) + 1.0f, 0.0f, limit))};
}

SPLAT_FN Range rows_of(const Splat& s, float top, float size, int count) {
  const float reach = s.extent_y + margin_of(s.y, s.extent_y), y = s.y - top;
  return cells(y - reach, y + reach, size, count);
}

SPLAT_FN Ellipse<float> ellipse_of(const Splat& s) { return {s.x, s.y, s.extent_y, s.c * s.c, s.level, s.inverse_a, s.tilt, s.slant}; }

// Columns, counted from `left`, of the cells that the ellipse meets in a row of cells from `row_top` on.
SPLAT_FN Range columns_of(const Splat& s, float left, float row_top, float width, float height, int count) {
  const Span<float> x = row_span(ellipse_of(s), row_top + 0.5f, row_top + (height - 0.5f));
  const float margin = margin_of(s.x, s.extent_x);
  return cells(x.low - margin - left, x.high + margin - left, width, count);
}

}  // namespace splat
