// The interface between the driver of polar_to_image and its kernels.
#pragma once

#include <cstdint>

#include "numbers.h"
#include "tier.h"

namespace darswin {

// The six numbers that map a pixel to the polar plane: d = inverse (p - center).
constexpr int64_t kPlane = 6;  // center x, y; inverse xx, xy, yx, yy
// The sums over pixels that backward needs in addition to the gradients of the radii: the gradient
// of d, and the gradient of d times p - center.
constexpr int64_t kSums = 6;
// The numbers that a plan keeps of each pixel: how many ring centres lie inside it, or -1 if it is
// zero; its place between two of them; its azimuth in sectors.
constexpr int64_t kPosition = 3;

template <typename T>
struct PolarToImageArgs {
  using Real = Arithmetic<T>;

  const T* x;           // (B, R, A, D)
  const Real* radii;    // (B or 1, R), rising
  const double* plane;  // (B or 1, kPlane), or null if there are points
  const Real* points;   // (B or 1, H, W, 2), or null
  const Real* r_max;    // (B or 1), or null
  const Real* plan;     // (B or 1, H, kPosition, W), or null
  int64_t radii_rows, place_rows, r_max_rows;
  int64_t plans;  // 1 if all images share their positions, else B
  int64_t batch, rings, sectors, channels, height, width;
  bool tokens;  // (B, H, W, D), else (B, D, H, W)

  int64_t bands;  // the number of bands of rows into which an image is cut

  T* out;           // forward
  Real* positions;  // make_plan: (plans, H, kPosition, W)

  const T* grad_out;  // backward
  T* grad_x;          // like x
  Real* partial;      // with several bands: (bands, B, R, A, D), to be summed over the bands
  int64_t lenses;     // 1 if all images share one lens, else B
  double* grad_rows;  // (lenses, H, R + kSums), to be summed over the rows; zero on entry
  Real* grad_points;  // (lenses, H, W, 2), or null
};

// The channels of one item of backward.
constexpr int64_t kChannelBlock = 32;

// Kernels process the items [begin, end) on one thread. The driver owns the threads.
template <typename T>
struct PolarToImageKernels {
  using Args = PolarToImageArgs<T>;
  // bytes of scratch for each thread that runs one of the functions below
  int64_t (*scratch)(const Args&);
  // item: (plan, row of pixels) -> positions
  void (*make_plan)(const Args&, int64_t begin, int64_t end, void* scratch);
  // item: (band of rows, image)
  void (*forward)(const Args&, int64_t begin, int64_t end, void* scratch);
  // item: (band of rows, image, block of channels) -> grad_x or partial
  void (*backward_map)(const Args&, int64_t begin, int64_t end, void* scratch);
  // item: value of grad_x, the sum of partial over the bands
  void (*sum_bands)(const Args&, int64_t begin, int64_t end);
  // item: (lens, row of pixels) -> grad_rows and grad_points
  void (*backward_lens)(const Args&, int64_t begin, int64_t end, void* scratch);
};

}  // namespace darswin
