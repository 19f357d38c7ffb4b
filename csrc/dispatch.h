// What the operator drivers (torch side) and the kernels (compiled once per tier) agree on: plain
// argument structs and one table of function pointers a tier. No torch header, no STL.
#pragma once

#include <cstdint>

namespace darswin {

struct bfloat16 {
  uint16_t bits;
};

enum class Pixel { f32, f64, bf16, u8 };

// Point (i, j) of image b stands at
// center[b] + affine[b] @ (radii[b, i] * (cos, sin)(azimuths[j])) + offsets[b, :, i, j].
// T is the type that is computed in: double for double pixels, else float.
template <typename T>
struct PolarSampleArgs {
  const void* image;  // (B, C, H, W), any strides
  Pixel pixel;
  int64_t channels, height, width;
  int64_t image_stride[4];
  bool packed;            // whether images are sampled from a packed copy in cache
  const T* pixel_scale;   // (C,): a pixel p of type u8 counts as p * scale + offset
  const T* pixel_offset;  // (C,)
  const T* radii;         // (B or 1, num_radii) px
  int64_t radii_stride, num_radii;
  const double* cosines;  // (num_azimuths,), readable for a register more
  const double* sines;    // the same
  bool directions_known;  // whether all of these are numbers
  int64_t num_azimuths;
  const T* center;  // (B or 1, 2) px, x then y
  int64_t center_stride;
  const T* affine;  // (B or 1, 2, 2), or null: the identity
  int64_t affine_stride;
  const T* offsets;  // (B or 1, 2, num_radii, num_azimuths) px, x then y, or null: none
  const T* offsets_end;
  int64_t offsets_stride;
  int64_t patch_radii, patch_azimuths;  // S_r, S_phi
  bool tokens;                          // layout: (B, R, A, S_r * S_phi * C), else (B, C, N_r, N_a)
  double jitter;
  uint64_t seed;
  bool narrow;  // out and grad_out are bfloat16, else T

  void* out;  // forward

  const void* grad_out;  // backward
  int64_t bands;         // into how many parts the rows of an image are cut
  void* grad_image;      // (B, C, H, W) contiguous, of the pixel's type; all of it is written
  double* grad_lens;     // (B, num_radii, kLensSums)
  T* grad_offsets;       // like offsets, to be added to; or null
};

// What polar_sample_backward_lens sums over a row of points: d(loss)/dr, the same times the shift
// of points that jitter moved inward and outward, d(loss)/d(x, y), and, where there is a matrix,
// d(loss)/d(affine) from kAffine on.
enum LensSum { kAlong, kInward, kOutward, kAcross, kDown, kAffine, kLensSums = kAffine + 4 };

// What a kernel does with the samples: makes them (polar_embed's gradient of the weight does too),
// or brings their gradients to the image, to the lens or, of polar_embed, to memory.
enum class PolarPass { forward, backward_image, backward_lens, backward_samples };

// The cells beside radius i, which jitter moves into: at both ends of the row the only one there
// is.
struct Steps {
  int64_t below[2], above[2];  // radius = radii[i] + shift * (radii[above] - radii[below]),
                               // [0] for negative shifts, [1] for others
  Steps(int64_t i, int64_t count) {
    const int64_t last = count - 1;
    below[0] = i > 0 ? i - 1 : 0;
    below[1] = i < last ? i : (last > 0 ? last - 1 : 0);
    for (int side = 0; side < 2; ++side) above[side] = below[side] < last ? below[side] + 1 : last;
  }
};

// Sampling and the linear layer behind it: out = samples of the token * weight^T + bias. Beside the
// arguments of the sampling, whose layout is tokens and whose out and grad_out are (B, R, A, D).
// Sizes are padded to kRowUnit values, so that rows are whole registers on every tier.
constexpr int64_t kRowUnit = 16;
template <typename T>
struct PolarEmbedArgs {
  int64_t features;     // D
  const T* transposed;  // forward: the weight as (S_r * S_phi * C, padded D)
  const T* bias;        // (D,) or null
  const T* weight;      // backward: (D, padded S_r * S_phi * C)
  T* grad_samples;      // (B, R, A, S_r * S_phi * C)
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

// x += y, then y = x normalized over its last axis * weight + bias.
template <typename S>
struct AddNormArgs {
  S *x, *y;                    // (rows, width)
  const float *weight, *bias;  // (width,)
  float eps;
  int64_t width;
};

// to = the transpose of `from`. The rows are taken in groups; each has its own sums of columns.
constexpr int64_t kTransposedRows = 64;
struct TransposeSumArgs {
  const float* from;  // (rows, columns)
  float* to;          // (columns, rows)
  float* sums;        // (groups, columns)
  int64_t rows, columns;
};

// Kernels are serial over [begin, end) of their work items; the drivers own the threads.
template <typename T>
struct KernelTable {
  // (n,) angles -> their cosines and sines, n a multiple of the lanes
  void (*directions)(const double* angles, int64_t n, double* cosines, double* sines);
  // bytes of scratch that each thread needs in one of the functions of polar_sample below
  int64_t (*polar_sample_scratch)(const PolarSampleArgs<T>&, PolarPass);
  // item: (image, ring)
  void (*polar_sample)(const PolarSampleArgs<T>&, int64_t begin, int64_t end, void* scratch);
  // item: (image, band)
  void (*polar_sample_backward_image)(const PolarSampleArgs<T>&, int64_t begin, int64_t end,
                                      void* scratch);
  // item: (image, ring)
  void (*polar_sample_backward_lens)(const PolarSampleArgs<T>&, int64_t begin, int64_t end,
                                     void* scratch);
  // (rows, columns) -> (columns, to_stride)
  void (*transpose)(const T* from, int64_t rows, int64_t columns, T* to, int64_t to_stride);
  // bytes of scratch that each thread needs in one of the functions of polar_embed below
  int64_t (*polar_embed_scratch)(const PolarSampleArgs<T>&, const PolarEmbedArgs<T>&, PolarPass);
  // item: (image, ring)
  void (*polar_embed)(const PolarSampleArgs<T>&, const PolarEmbedArgs<T>&, int64_t begin,
                      int64_t end, void* scratch);
  // item: (image, ring); adds to weight (D, padded S_r * S_phi * C) and bias (D,)
  void (*polar_embed_backward_weight)(const PolarSampleArgs<T>&, const PolarEmbedArgs<T>&,
                                      int64_t begin, int64_t end, T* weight, double* bias,
                                      void* scratch);
  // item: (image, ring); writes grad_samples
  void (*polar_embed_backward_samples)(const PolarSampleArgs<T>&, const PolarEmbedArgs<T>&,
                                       int64_t begin, int64_t end, void* scratch);
  // item: image, as one band; the gradients of the samples are used as soon as they are there
  void (*polar_embed_backward_image)(const PolarSampleArgs<T>&, const PolarEmbedArgs<T>&,
                                     int64_t begin, int64_t end, void* scratch);
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

// item: row
template <typename S>
using AddNorm = void (*)(const AddNormArgs<S>&, int64_t begin, int64_t end);

struct Kernels {
  const char* tier;
  KernelTable<float> f32;
  KernelTable<double> f64;
  WindowAttentionTable<float> attention_f32;
  WindowAttentionTable<double> attention_f64;
  WindowAttentionTable<bfloat16> attention_bf16;
  AddNorm<float> add_norm_f32;
  AddNorm<bfloat16> add_norm_bf16;
  // item: group of rows
  void (*transpose_sum)(const TransposeSumArgs&, int64_t begin, int64_t end);

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

  template <typename S>
  AddNorm<S> add_norm() const {
    if constexpr (sizeof(S) == sizeof(float)) {
      return add_norm_f32;
    } else {
      return add_norm_bf16;
    }
  }
};

// The tier in use: the best one the CPU has, or what ATEN_CPU_CAPABILITY or set_tier asked for.
const Kernels& kernels();

const char* best_tier();          // what the CPU has
bool set_tier(const char* tier);  // false where the CPU or the build lacks that tier
bool tier_available(const char* tier);

}  // namespace darswin
