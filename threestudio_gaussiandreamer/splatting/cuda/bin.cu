// Stages 3 to 5: assign the splats, sorted by depth, to the tiles that they overlap. An intersection is a pair of a splat and a tile;
// they are numbered front to back, so a stable sort by tile keeps the list of each tile front to back.
#include "reach.h"

namespace splat {

// Not inlined, so that counting and listing use the same machine code and get the same tiles to the bit.
static __device__ __noinline__ Range tile_rows(const Splat& splat, int count) { return rows_of(splat, 0.0f, TILE, count); }

static __device__ __noinline__ Range tile_columns(const Splat& splat, int row, int count) {
  return columns_of(splat, 0.0f, float(row * TILE), TILE, TILE, count);
}

// The splat of this thread, which is one rank of one view's order; null behind the last visible one.
SPLAT_FN const Splat* splat_of_rank(const Scene& scene, const Splat* splats, const Index* order, Index& at, Index& splat) {
  const Index rank = Index(blockIdx.x) * blockDim.x + threadIdx.x, first = Index(blockIdx.y) * scene.gaussians;
  if (rank >= scene.gaussians) return nullptr;
  at = first + rank, splat = first + order[at];
  return splats[splat].level >= 0.0f ? splats + splat : nullptr;
}

}  // namespace splat

// Stage 3: counts (B, N) of tiles by rank; the caller has cleared them.
extern "C" __global__ void __launch_bounds__(128)
count_tiles(splat::Scene scene, const splat::Splat* splats, const splat::Index* order, int* counts) {
  using namespace splat;
  Index at, index;
  const Splat* splat = splat_of_rank(scene, splats, order, at, index);
  if (!splat) return;
  const Range rows = tile_rows(*splat, tiles_along(scene.height));
  int count = 0;
  for (int row = rows.begin; row < rows.end; row++) {
    const Range columns = tile_columns(*splat, row, tiles_along(scene.width));
    count += maximum(columns.end - columns.begin, 0);
  }
  counts[at] = count;
}

// Stage 4: tile and owner (view * N + Gaussian) of each intersection. `ends` is the running sum of the counts. What doesn't fit into
// the capacity is skipped; the blend detects this and does not use the lists.
extern "C" __global__ void __launch_bounds__(128)
list_tiles(splat::Scene scene, const splat::Splat* splats, const splat::Index* order, const int* counts,
           const splat::Index* ends, splat::Index capacity, int* tiles, int* owners) {
  using namespace splat;
  Index at, index;
  const Splat* splat = splat_of_rank(scene, splats, order, at, index);
  if (!splat) return;
  const int tiles_x = tiles_along(scene.width), tiles_y = tiles_along(scene.height), first_tile = blockIdx.y * tiles_x * tiles_y;
  const Range rows = tile_rows(*splat, tiles_y);
  const Index end = minimum(ends[at], capacity);
  Index at_tile = ends[at] - counts[at];
  for (int row = rows.begin; row < rows.end; row++) {
    const Range columns = tile_columns(*splat, row, tiles_x);
    for (int column = columns.begin; column < columns.end && at_tile < end; column++, at_tile++) {
      tiles[at_tile] = first_tile + row * tiles_x + column;
      owners[at_tile] = int(index);
    }
  }
}

// Stage 5: where the intersections of each tile begin, sorted by tile; `begins` has one more element than there are tiles.
extern "C" __global__ void __launch_bounds__(128)
find_tiles(const int* sorted_tiles, splat::Index capacity, int tiles, splat::Index* begins) {
  using namespace splat;
  const int tile = blockIdx.x * blockDim.x + threadIdx.x;
  if (tile > tiles) return;
  Index low = 0, high = capacity;
  while (low < high) {
    const Index middle = (low + high) / 2;
    if (sorted_tiles[middle] < tile) low = middle + 1;
    else high = middle;
  }
  begins[tile] = low;
}
