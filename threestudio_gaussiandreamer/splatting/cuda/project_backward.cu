// The adjoints of stages 5 to 1: each splat adds up the rows of its intersections, each Gaussian takes its splats' gradients through
// the projection, view after view. Every sum has a fixed order.
#include "launch.h"

namespace splat {

constexpr int THREADS = 128, CAMERA_SUMS = 12;  // d loss / d viewmat but for its last row
constexpr int CAMERA_ROWS = 32;  // threads per column of these that add up the blocks' parts
constexpr int SUM_LANES = 4, RANKS = WARP / SUM_LANES;  // lanes that add the rows of one splat, a quad each; splats of a warp

// What a backward pass fills.
struct Gradients {
  float *means, *quats, *scales, *opacities, *colors;  // as in Scene
  float* means2d;   // (B, N, 2)
  float* absgrad;   // (B, N, 2) or null: the sum over pixels of the absolute value is added
  float* camera_parts;  // (blocks, B, 12) or null: each block's part in d loss / d viewmats
};

// One Gaussian's part in d loss / d viewmat but for its last row.
SPLAT_FN void viewmat_part(const Gaussian<float>& g, const Mat3<float>& axes, const ViewGradient<float>& d, float* part) {
  const Mat3<float> rotation = view_rotation_vjp(g.mean, axes, d);
  store3(part, rotation.x), part[3] = d.t.x;
  store3(part + 4, rotation.y), part[7] = d.t.y;
  store3(part + 8, rotation.z), part[11] = d.t.z;
}

// The block's sum of each column, in the order of the warps; called by all threads.
SPLAT_FN void sum_block(const float* columns, float* out) {
  __shared__ float parts[THREADS / WARP][CAMERA_SUMS];
  for (int column = 0; column < CAMERA_SUMS; column++) {
    float sum = columns[column];
    for (int step = WARP / 2; step > 0; step /= 2) sum += __shfl_xor_sync(FULL, sum, step);
    if (threadIdx.x % WARP == 0) parts[threadIdx.x / WARP][column] = sum;
  }
  __syncthreads();
  if (threadIdx.x < CAMERA_SUMS) {
    const int column = threadIdx.x;
    out[column] = (parts[0][column] + parts[1][column]) + (parts[2][column] + parts[3][column]);
  }
  __syncthreads();
}

// Through rotation and scale; a Gaussian that no view renders has zero gradients, finite or not.
SPLAT_FN void store_world(const Gradients& out, Index i, const Gaussian<float>& g, const Rotation<float>& rotation,
                          const WorldGradient<float>& d, bool drawn) {
  Mat3<float> d_rotation;
  Vec3<float> d_scale = {};
  Vec4<float> d_quat = {};
  if (drawn) {
    world_axes_vjp(rotation.matrix, g.scale, d.axes, d_rotation, d_scale);
    d_quat = quat_to_rotation_vjp(rotation, d_rotation);
  }
  store3(out.means + 3 * i, d.mean), store3(out.scales + 3 * i, d_scale);
  out.quats[4 * i] = d_quat.w, store3(out.quats + 4 * i + 1, {d_quat.x, d_quat.y, d_quat.z});
  out.opacities[i] = d.opacity;
}

SPLAT_FN void store_screen(const Gradients& out, Index at, const Vec2<float>& mean2d, const Vec2<float>& absolute) {
  out.means2d[2 * at] = mean2d.x, out.means2d[2 * at + 1] = mean2d.y;
  if (out.absgrad) out.absgrad[2 * at] += absolute.x, out.absgrad[2 * at + 1] += absolute.y;
}

// The rows of a rank of a view's order: [begin, end), of view * N + Gaussian `owner`. Empty, with owner -1, behind the last visible one.
struct RowSpan {
  Index begin, end, owner;
};

SPLAT_FN RowSpan rows_of_rank(const Scene& scene, const int* depth_keys, const Index* order, const int* counts, const Index* ends,
                              Index rank) {
  if (rank >= scene.gaussians) return {0, 0, -1};
  const Index first = Index(blockIdx.y) * scene.gaussians, at = first + rank, owner = first + order[at];
  if (depth_keys[owner] == CULLED) return {0, 0, -1};
  return {ends[at] - counts[at], ends[at], owner};
}

// The sum over the lanes of a warp with the same quad.
SPLAT_FN Quad across_ranks(Quad sum) {
  for (int step = SUM_LANES; step < WARP; step *= 2) {
    const float x = __shfl_xor_sync(FULL, sum.x, step), y = __shfl_xor_sync(FULL, sum.y, step);
    const float z = __shfl_xor_sync(FULL, sum.z, step), w = __shfl_xor_sync(FULL, sum.w, step);
    sum = sum + Quad{x, y, z, w};
  }
  return sum;
}

}  // namespace splat

// Rows of the intersections to sums (B, N) of rows; those of invisible Gaussians stay as they are. SUM_LANES lanes per rank add its
// first rows, a quad each. Then the whole warp adds the others of each of its ranks, so that a Gaussian that covers the screen takes
// no thread thousands of steps.
extern "C" __global__ void __launch_bounds__(128, 8)
sum_rows(splat::Scene scene, const int* depth_keys, const splat::Index* order, const int* counts, const splat::Index* ends,
         const splat::Row* rows, splat::Row* sums) {
  using namespace splat;
  constexpr int FIRST_ROWS = 4;
  const int lane = threadIdx.x % WARP, quad = lane % SUM_LANES, own = lane / SUM_LANES;
  const Index first_rank = (Index(blockIdx.x) * blockDim.x + threadIdx.x) / WARP * RANKS;
  const auto sum_every = [&](int stride, Index begin, Index end) {
    Quad sum = {};
    if (quad < ROW_QUADS)
#pragma unroll 4
      for (Index i = begin; i < end; i += stride) sum = sum + reinterpret_cast<const Quad*>(rows + i)[quad];
    return sum;
  };
  const RowSpan span = rows_of_rank(scene, depth_keys, order, counts, ends, first_rank + own);
  Quad sum = sum_every(1, span.begin, minimum(span.end, span.begin + FIRST_ROWS));
  const unsigned longer = __ballot_sync(FULL, span.end - span.begin > FIRST_ROWS);
  for (int k = 0; k < RANKS; k++) {
    if (!(longer >> (k * SUM_LANES) & 1)) continue;
    const RowSpan others = rows_of_rank(scene, depth_keys, order, counts, ends, first_rank + k);
    const Quad rest = across_ranks(sum_every(RANKS, others.begin + FIRST_ROWS + own, others.end));
    if (k == own) sum = sum + rest;
  }
  if (span.owner >= 0 && quad < ROW_QUADS) reinterpret_cast<Quad*>(sums + span.owner)[quad] = sum;
}

extern "C" __global__ void __launch_bounds__(128, 3)
project_backward(splat::Scene scene, splat::Settings settings, const int* depth_keys, const splat::Row* sums,
                 splat::Gradients out) {
  using namespace splat;
  const int i = blockIdx.x * THREADS + threadIdx.x;
  const bool exists = i < scene.gaussians;
  const Gaussian<float> g = exists ? load_gaussian(scene, settings, i) : Gaussian<float>{};
  const Rotation<float> rotation = quat_to_rotation(g.quat);
  const Mat3<float> axes = world_axes(rotation.matrix, g.scale);
  WorldGradient<float> world = {};
  bool drawn_anywhere = false;
  for (int view = 0; view < scene.views; view++) {
    const Camera camera = make_camera(scene, view);
    const Index at = Index(view) * scene.gaussians + i;
    const bool drawn = exists && depth_keys[at] != CULLED;
    ViewGradient<float> d = {};
    Vec2<float> absolute = {};
    float viewmat[CAMERA_SUMS] = {};
    if (drawn) {
      const Row& row = sums[at];
      d = project_vjp(camera, splat::project(camera, g.mean, axes, settings.eps2d), g.opacity, settings.antialias, row.sums);
      absolute = {UNSCALE * UNSCALE * row.sums[ABS_X], UNSCALE * UNSCALE * row.sums[ABS_Y]};
      add_view(world, camera, d);
      viewmat_part(g, axes, d, viewmat);
    }
    drawn_anywhere |= drawn;
    if (exists) store_screen(out, at, d.mean2d, absolute);
    if (exists && scene.colors_per_view) store3(out.colors + 3 * at, d.color);
    if (out.camera_parts) sum_block(viewmat, out.camera_parts + (Index(blockIdx.x) * scene.views + view) * CAMERA_SUMS);
  }
  if (exists) store_world(out, i, g, rotation, world, drawn_anywhere);
  if (exists && !scene.colors_per_view) store3(out.colors + 3 * Index(i), world.color);
}

// The blocks' parts to d loss / d viewmats (B, 4, 4), with zeros in the last row; one block per view, in the y direction.
extern "C" __global__ void __launch_bounds__(384)
sum_cameras(splat::Scene scene, const float* parts, int blocks, float* viewmats) {
  using namespace splat;
  __shared__ double sums[CAMERA_ROWS][CAMERA_SUMS];
  const int column = threadIdx.x % CAMERA_SUMS, row = threadIdx.x / CAMERA_SUMS;
  double sum = 0;
  for (Index block = row; block < blocks; block += CAMERA_ROWS) sum += parts[(block * scene.views + blockIdx.y) * CAMERA_SUMS + column];
  sums[row][column] = sum;
  __syncthreads();
  if (threadIdx.x >= 16) return;
  double total = 0;
  if (threadIdx.x < CAMERA_SUMS)
    for (int i = 0; i < CAMERA_ROWS; i++) total += sums[i][threadIdx.x];
  viewmats[16 * Index(blockIdx.y) + threadIdx.x] = float(total);
}
