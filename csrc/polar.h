// What the drivers of polar_sample and polar_embed and their kernels agree on.
#pragma once

#include <cstdint>

#include "tier.h"

namespace darswin {

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
  bool gathers;           // whether they are read by gathers
  const T* pixel_scale;   // (C,): a pixel p of type u8 counts as p * scale + offset
  const T* pixel_offset;  // (C,)
  const T* radii;         // (B or 1, num_radii) px
  int64_t radii_stride, num_radii;
  const double* cosines;   // (num_azimuths,), readable for one register more
  const double* sines;     // the same
  bool directions_finite;  // whether all cosines and sines are numbers
  int64_t num_azimuths;
  const T* center;  // (B or 1, 2) px, x then y
  int64_t center_stride;
  const T* affine;  // (B or 1, 2, 2), or null: the identity
  int64_t affine_stride;
  const T* offsets;  // (B or 1, 2, num_radii, num_azimuths) px, x then y, or null: none
  const T* offsets_end;
  int64_t offsets_stride;
  int64_t samples_r, samples_a;  // S_r, S_phi: the samples of a token along radius and azimuth
  bool tokens;                   // layout: (B, R, A, S_r * S_phi * C), else (B, C, N_r, N_a)
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

// What PolarSampleKernels::backward_lens sums over the points of one radius: d(loss)/dr, the same
// times the shift of the points that jitter moved inward and of those it moved outward,
// d(loss)/d(x, y) and, where there is a matrix, d(loss)/d(affine) from kAffine on.
enum LensSum { kAlong, kInward, kOutward, kAcross, kDown, kAffine, kLensSums = kAffine + 4 };

// What a kernel needs scratch for: to make samples (forward, and the gradient of polar_embed's
// weight), or to bring their gradients to the image, to the lens or, in polar_embed, to memory.
enum class PolarPass { forward, backward_image, backward_lens, backward_samples };

// Kernels work serially through the items [begin, end); the drivers own the threads.
template <typename T>
struct PolarSampleKernels {
  using Args = PolarSampleArgs<T>;

  // (n,) angles -> their cosines and sines, n a multiple of the lanes
  void (*directions)(const double* angles, int64_t n, double* cosines, double* sines);
  // bytes of scratch that each thread needs in one of the functions below
  int64_t (*scratch)(const Args&, PolarPass);
  // item: (image, ring)
  void (*forward)(const Args&, int64_t begin, int64_t end, void* scratch);
  // item: (image, band)
  void (*backward_image)(const Args&, int64_t begin, int64_t end, void* scratch);
  // item: (image, ring)
  void (*backward_lens)(const Args&, int64_t begin, int64_t end, void* scratch);
};

// Sampling and the linear layer behind it: out = samples of the token * weight^T + bias. These are
// the arguments beside those of the sampling, whose layout is tokens and whose out and grad_out are
// (B, R, A, D). "Padded" sizes are multiples of kRowUnit, so that rows are whole registers on every
// tier.
constexpr int64_t kRowUnit = 16;
template <typename T>
struct PolarEmbedArgs {
  int64_t features = 0;           // D
  const T* transposed = nullptr;  // forward: the weight as (S_r * S_phi * C, padded D)
  const T* bias = nullptr;        // (D,) or null
  const T* weight = nullptr;      // backward: (D, padded S_r * S_phi * C)
  T* grad_samples = nullptr;      // (B, R, A, S_r * S_phi * C)
};

template <typename T>
struct PolarEmbedKernels {
  using Args = PolarSampleArgs<T>;
  using Embed = PolarEmbedArgs<T>;

  // bytes of scratch that each thread needs in one of the functions below
  int64_t (*scratch)(const Args&, const Embed&, PolarPass);
  // item: (image, ring)
  void (*forward)(const Args&, const Embed&, int64_t begin, int64_t end, void* scratch);
  // item: (image, ring); adds to weight (D, padded S_r * S_phi * C) and bias (D,)
  void (*backward_weight)(const Args&, const Embed&, int64_t begin, int64_t end, T* weight,
                          double* bias, void* scratch);
  // item: (image, ring); writes grad_samples
  void (*backward_samples)(const Args&, const Embed&, int64_t begin, int64_t end, void* scratch);
  // item: image, as one band; the gradients of the samples go to the image at once
  void (*backward_image)(const Args&, const Embed&, int64_t begin, int64_t end, void* scratch);
};

namespace {

// The steps by which jitter moves a point from radius i: the radius becomes
// radii[i] + shift * (radii[above] - radii[below]), with entry 0 of both for a negative shift and 1
// for another. At both ends of the row there is only one step.
struct Steps {
  int64_t below[2], above[2];

  Steps(int64_t i, int64_t count) {
    const int64_t last = count - 1;
    below[0] = i > 0 ? i - 1 : 0;
    below[1] = i < last ? i : (last > 0 ? last - 1 : 0);
    for (int side = 0; side < 2; ++side) above[side] = below[side] < last ? below[side] + 1 : last;
  }
};

}  // namespace

}  // namespace darswin
