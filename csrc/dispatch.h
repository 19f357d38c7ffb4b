// What the operator drivers (torch side) and the kernels (compiled once per tier) agree on: plain
// argument structs and one table of function pointers a tier. No torch header, no STL.
#pragma once

#include <cstdint>

namespace darswin {

struct bfloat16 {
  uint16_t bits;
};

// Point (i, j) of image b stands at center[b] + radii[b, i] * (cos, sin)(azimuths[j]).
template <typename T>
struct PolarSampleArgs {
  const T* image;  // (B, C, H, W), any strides; backward: contiguous, as grad_image is
  int64_t channels, height, width;
  int64_t image_stride[4];
  const T* radii;  // (B or 1, num_radii) px
  int64_t radii_stride, num_radii;
  const double* cosines;  // (num_azimuths,)
  const double* sines;    // (num_azimuths,)
  int64_t num_azimuths;
  const T* center;  // (B or 1, 2) px, x then y
  int64_t center_stride;
  int64_t patch_radii, patch_azimuths;  // S_r, S_phi
  bool tokens;                          // layout: (B, R, A, S_r * S_phi * C), else (B, C, N_r, N_a)
  double jitter;
  uint64_t seed;

  T* out;  // forward

  const T* grad_out;    // backward; a null pointer below means "not wanted"
  T* grad_image;        // (B, C, H, W), zero on entry
  double* grad_radii;   // (B, num_radii), zero on entry; with it goes
  double* grad_center;  // (B, 2), zero on entry
};

// The type in which a storage type is computed.
template <typename T>
struct ArithmeticOf {
  using type = T;
};
template <>
struct ArithmeticOf<bfloat16> {
  using type = float;
};
template <typename T>
using Arithmetic = typename ArithmeticOf<T>::type;

// Windows of a polar map; token (r, a) of the rolled map is token (r + shift_r, a + shift_a) of it.
// Windows are counted over all images: window w lies in image w / (windows of an image).
template <typename T>
struct WindowAttentionArgs {
  using Real = Arithmetic<T>;

  const T* qkv;      // (B, R, A, 3, heads, d)
  const Real* bias;  // (B or 1, heads, 2 M_r - 1, 2 M_a - 1)
  int64_t bias_rows, windows;
  int64_t rings, sectors, heads, head_dim;
  int64_t window_r, window_a, shift_r, shift_a;
  bool periodic_r, periodic_a;
  Real scale;

  T* out;  // forward: (B, R, A, heads, d)

  const T* grad_out;  // backward
  T* grad_qkv;        // like qkv
  double* grad_bias;  // (chunks of a bias row, B or 1, heads, 2 M_r - 1, 2 M_a - 1), to be summed
                      // over the chunks; zero on entry
  int64_t chunk;      // windows that share one row of bias gradients
};

// Kernels are serial over [begin, end) of their work items; the drivers own the threads.
template <typename T>
struct KernelTable {
  // item: (image, radius index)
  void (*polar_sample)(const PolarSampleArgs<T>&, int64_t begin, int64_t end);
  // item: image
  void (*polar_sample_backward)(const PolarSampleArgs<T>&, int64_t begin, int64_t end);
};

template <typename T>
struct WindowAttentionTable {
  // bytes of scratch that each thread needs in the two functions below
  int64_t (*scratch)(const WindowAttentionArgs<T>&);
  // item: (window, head)
  void (*forward)(const WindowAttentionArgs<T>&, int64_t begin, int64_t end, void* scratch);
  // item: (chunk of windows, head)
  void (*backward)(const WindowAttentionArgs<T>&, int64_t begin, int64_t end, void* scratch);
};

struct Kernels {
  const char* tier;
  KernelTable<float> f32;
  KernelTable<double> f64;
  WindowAttentionTable<float> attention_f32;
  WindowAttentionTable<double> attention_f64;
  WindowAttentionTable<bfloat16> attention_bf16;

  template <typename T>
  const KernelTable<T>& table() const {
    if constexpr (sizeof(T) == sizeof(float)) {
      return f32;
    } else {
      return f64;
    }
  }

  template <typename T>
  const WindowAttentionTable<T>& attention() const {
    if constexpr (sizeof(T) == sizeof(float)) {
      return attention_f32;
    } else if constexpr (sizeof(T) == sizeof(double)) {
      return attention_f64;
    } else {
      return attention_bf16;
    }
  }
};

// The tier in use: the best one the CPU has, or what ATEN_CPU_CAPABILITY or set_tier asked for.
const Kernels& kernels();

const char* best_tier();          // what the CPU has
bool set_tier(const char* tier);  // false where the CPU or the build lacks that tier
bool tier_available(const char* tier);

}  // namespace darswin
