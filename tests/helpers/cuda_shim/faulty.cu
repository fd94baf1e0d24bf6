// Kernels with the two errors that the emulation must detect.
#include "launch.h"

// Every second thread ends before a barrier that the others wait at.
extern "C" __global__ void faulty_barrier(int* out) {
  if (threadIdx.x % 2) return;
  __syncthreads();
  out[threadIdx.x] = 1;
}

// Reads what another thread writes, with no barrier between the two.
extern "C" __global__ void faulty_race(int* out) {
  __shared__ int values[64];
  values[threadIdx.x] = 1;
  out[threadIdx.x] = values[63 - threadIdx.x];
}
