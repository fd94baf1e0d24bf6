// The package's CUDA source, compiled for the host.
#include "cuda_shim.h"

#include "project.cu"
#include "bin.cu"
#include "blend.cu"
#include "blend_backward.cu"
#include "project_backward.cu"
#include "faulty.cu"

extern "C" {

// 0, or 1 with a message in `shim_error`.
int shim_launch(const char* name, unsigned grid_x, unsigned grid_y, unsigned threads, int order, void** arguments) {
  const std::string kernel = name;
  std::function<void()> run;
#define KERNEL(NAME) \
  if (kernel == #NAME) run = shim::bind(NAME, arguments)
  KERNEL(project);
  KERNEL(count_tiles);
  KERNEL(list_tiles);
  KERNEL(find_tiles);
  KERNEL(blend);
  KERNEL(blend_backward);
  KERNEL(blend_backward_absolute);
  KERNEL(sum_rows);
  KERNEL(project_backward);
  KERNEL(sum_cameras);
  KERNEL(faulty_barrier);
  KERNEL(faulty_race);
#undef KERNEL
  if (!run) return shim::block.error = "no kernel is called " + kernel, 1;
  return shim::run_grid({grid_x, grid_y, 1}, threads, shim::Order(order), run) ? 0 : 1;
}

const char* shim_error() { return shim::block.error.c_str(); }
}
