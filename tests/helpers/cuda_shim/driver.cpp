// The part of NVIDIA's driver interface that the package uses, on top of the emulation. Rejects what a driver rejects.
#include <cstring>
#include <string>

extern "C" {
int shim_launch(const char* name, unsigned grid_x, unsigned grid_y, unsigned threads, int order, void** arguments);

enum { SUCCESS = 0, INVALID_IMAGE = 200, INVALID_CONTEXT = 201, NOT_FOUND = 500, LAUNCH_FAILED = 719 };
static int context_of_device, stream_of_torch;
static thread_local void* current;
int fake_loads;          // modules loaded
int fake_release = 13000;  // 13.0

void* fake_stream() { return &stream_of_torch; }

int cuInit(unsigned) { return SUCCESS; }
int cuDriverGetVersion(int* release) { return *release = fake_release, SUCCESS; }
int cuDeviceGet(int* device, int index) { return *device = 40 + index, SUCCESS; }
int cuDevicePrimaryCtxRetain(void** context, int device) { return *context = device == 40 ? &context_of_device : nullptr, SUCCESS; }
int cuCtxSetCurrent(void* context) { return current = context, SUCCESS; }

int cuModuleLoadData(void** module, const char* image) {
  if (current != &context_of_device) return INVALID_CONTEXT;
  if (std::memcmp(image, "\x7f" "ELF", 4) && !std::strstr(image, ".version")) return INVALID_IMAGE;
  return *module = &fake_loads, fake_loads++, SUCCESS;
}

int cuModuleGetFunction(void** function, void* module, const char* name) {
  if (module != &fake_loads) return NOT_FOUND;
  return *function = strdup(name), SUCCESS;
}

int cuLaunchKernel(void* function, unsigned grid_x, unsigned grid_y, unsigned grid_z, unsigned x, unsigned y, unsigned z,
                   unsigned shared, void* stream, void** arguments, void** extra) {
  if (current != &context_of_device) return INVALID_CONTEXT;
  if (grid_z != 1 || y != 1 || z != 1 || shared || extra || stream != &stream_of_torch) return LAUNCH_FAILED;
  return shim_launch(static_cast<const char*>(function), grid_x, grid_y, x, 0, arguments) ? LAUNCH_FAILED : SUCCESS;
}

int cuGetErrorString(int status, const char** text) {
  *text = status == INVALID_IMAGE ? "device kernel image is invalid" : status == INVALID_CONTEXT ? "invalid device context" : "failed";
  return SUCCESS;
}
}
