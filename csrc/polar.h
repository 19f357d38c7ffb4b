// The interface between the driver of polar_sample and its kernels.
#pragma once

#include <cstdint>

#include "tier.h"

namespace darswin {

enum class Pixel { f32, f64, bf16, u8 };

// Point (i, j) of image b lies at
// center[b] + affine[b] @ (radii[b, i] * (cos, sin)(azimuths[j])) + offsets[b, :, i, j].
// T is the type used for computing: double for double pixels, else float.
template <typename T>
struct PolarSampleArgs {
  const void* image;  // (B, C, H, W), any strides
  Pixel pixel;
  int64_t channels, height, width;
  int64_t image_stride[4];
  bool packed;            // samples come from a packed copy of the image, else directly from it
  bool gathers;           // pixels are read by gathers
  const T* pixel_scale;   // (C,), followed by three zeros: a pixel p of type u8 has the value
  const T* pixel_offset;  // p * scale + offset; the same
  const T* radii;         // (B or 1, num_radii) px
  int64_t radii_stride, num_radii;
  const double* cosines;   // (num_azimuths,), followed by one readable register
  const double* sines;     // the same
  bool directions_finite;  // all cosines and sines are numbers
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
  int64_t bands;         // the number of parts into which the rows of an image are cut
  void* grad_image;      // (B, C, H, W) contiguous, of the pixel's type; fully written
  double* grad_lens;     // (B, num_radii, kLensSums)
  T* grad_offsets;       // like offsets; gradients are added to it; or null
};

// The sums of PolarSampleKernels::backward_lens over the points of one radius: d(loss)/dr, then
// d(loss)/dr times the shift of the points that jitter moved inward, and the same for those it
// moved outward, then d(loss)/d(x, y). If there is a matrix, d(loss)/d(affine) follows, starting at
// kAffine.
enum LensSum { kAlong, kInward, kOutward, kAcross, kDown, kAffine, kLensSums = kAffine + 4 };

// The purpose of a kernel's scratch memory.
enum class PolarPass { forward, backward_image, backward_lens };

// Kernels process the items [begin, end) on one thread. The drivers own the threads.
template <typename T>
struct PolarSampleKernels {
  using Args = PolarSampleArgs<T>;

  // (n,) angles -> their cosines and sines; n is a multiple of the lanes
  void (*directions)(const double* angles, int64_t n, double* cosines, double* sines);
  // bytes of scratch for each thread that runs one of the functions below
  int64_t (*scratch)(const Args&, PolarPass);
  // item: (image, ring)
  void (*forward)(const Args&, int64_t begin, int64_t end, void* scratch);
  // item: (image, band)
  void (*backward_image)(const Args&, int64_t begin, int64_t end, void* scratch);
  // item: (image, ring)
  void (*backward_lens)(const Args&, int64_t begin, int64_t end, void* scratch);
};

namespace {

// The steps by which jitter moves a point from radius i. The radius becomes radii[i] + shift *
// (radii[above] - radii[below]). A negative shift uses entry 0 of both arrays, other shifts use
// entry 1. At each end of the row there is only one step.
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
