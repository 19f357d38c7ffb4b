// Runs the forward of polar_to_image on the threads that its work is worth.
#pragma once

#include <algorithm>

#include "../polar_to_image.h"
#include "dispatch.h"
#include "parallel.h"

namespace darswin {

template <typename T>
Threads polar_to_image_threads(const PolarToImageArgs<T>& args) {
  const double pixels = static_cast<double>(args.height) * args.width;
  return threads_for(sampling_microseconds(args.batch * pixels, args.channels));
}

template <typename T>
void run_polar_to_image(PolarToImageArgs<T> args) {
  // Images with the same lens take turns, band by band, so that all of them use one plan of a band.
  // With few channels, low bands are faster, because their plan stays in the cache. With more, high
  // bands are up to 12 % faster, because the map and the pages of the image stay there instead.
  const Threads threads = polar_to_image_threads(args);
  const int64_t items = 4 * threads;
  const int64_t most = args.batch == 1 ? 1 : args.channels <= 4 ? 64 : args.height;
  const int64_t rows = std::clamp<int64_t>(args.height * args.batch / items, 1, most);
  args.bands = units(args.height, rows);
  const auto& kernel = kernels<PolarToImageKernels<T>>();
  run_with_scratch(args.batch * args.bands, threads, kernel.scratch(args),
                   [&](auto... range) { kernel.forward(args, range...); });
}

}  // namespace darswin
