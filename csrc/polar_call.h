// A call of polar_sample or polar_embed, checked and laid out as the kernels take it. The checks
// only keep memory safe; darswin/ops explains wrong arguments.
#pragma once

#include <torch/csrc/stable/ops.h>
#include <torch/csrc/stable/tensor.h>
#include <torch/headeronly/util/Exception.h>

#include <atomic>
#include <initializer_list>
#include <optional>
#include <tuple>
#include <vector>

#include "dispatch.h"
#include "faster.h"
#include "polar.h"

namespace darswin {

using Sizes = std::vector<int64_t>;

// An image is packed if its copy takes at most this many bytes, which stay in the second-level
// cache, and if it has at most this many pixels a point.
constexpr int64_t kPackedBytes = 3 << 19;
constexpr int64_t kPackedPixelsPerPoint = 4;
// Sums of bfloat16 pixels are float32, of four channels: no thread keeps more of them than this.
constexpr int64_t kSumsBytes = 24 << 20;

inline Pixel pixel_type(const torch::stable::Tensor& image) {
  using torch::headeronly::ScalarType;
  switch (image.scalar_type()) {
    case ScalarType::Float:
      return Pixel::f32;
    case ScalarType::Double:
      return Pixel::f64;
    case ScalarType::BFloat16:
      return Pixel::bf16;
    case ScalarType::Byte:
      return Pixel::u8;
    default:
      STD_TORCH_CHECK(false, "polar_sample: pixels must be float32, float64, bfloat16 or uint8");
  }
}

// RuntimeError unless 64 times the product of the sizes that are not 0 fits 64 bits. No size is
// negative.
void check_product(std::initializer_list<int64_t> sizes);

// The arguments that polar_sample and polar_embed share, in the order of their schemas.
struct Sampling {
  torch::stable::Tensor image, radii, azimuths, center;
  std::optional<torch::stable::Tensor> affine, offsets, jitter, seed;
  Sizes samples;  // (S_r, S_phi)
  std::vector<double> mean, std;
  bool bfloat16;  // the type of the output
};

// Listed<run>::call is run(Sampling, others...) as the dispatcher calls it, argument by argument.
template <auto run>
struct Listed;
template <typename Result, typename... Others, Result (*run)(const Sampling&, Others...)>
struct Listed<run> {
  using Tensor = torch::stable::Tensor;

  static Result call(Tensor image, Tensor radii, Tensor azimuths, Tensor center,
                     std::optional<Tensor> affine, std::optional<Tensor> offsets,
                     std::optional<Tensor> jitter, std::optional<Tensor> seed, Sizes samples,
                     std::vector<double> mean, std::vector<double> std, bool bfloat16,
                     Others... others) {
    return run({image, radii, azimuths, center, affine, offsets, jitter, seed, samples, mean, std,
                bfloat16},
               others...);
  }
};

// How far images are read: with gathers, without, or as is found to be faster.
enum class Gathers { never, always, measured };
extern std::atomic<Gathers> gathers;

// Whether gathers are faster for images like these, on so many threads.
Faster& faster_with_gathers(bool gray, bool large, bool threads);

// One call's arguments as the kernels take them. Owns what `args` points into.
template <typename T>
struct PolarCall {
  torch::stable::Tensor image, radii, center;
  std::optional<torch::stable::Tensor> affine, offsets;
  std::vector<double> directions;
  std::vector<T> scale, offset;
  PolarSampleArgs<T> args{};
  int64_t batch;

  explicit PolarCall(const Sampling& given);

  int64_t rings() const { return args.num_radii / args.samples_r; }
  int64_t sectors() const { return args.num_azimuths / args.samples_a; }
  int64_t token_size() const { return args.samples_r * args.samples_a * args.channels; }
  torch::headeronly::ScalarType output_type() const {
    return args.narrow ? torch::headeronly::ScalarType::BFloat16 : radii.scalar_type();
  }
  // Values of the packed image of the kernels; in double, since it may not fit 64 bits.
  double packed_values() const {
    return static_cast<double>(args.height + 3) * static_cast<double>(args.width + 3) *
           static_cast<double>((args.channels + 3) / 4 * 4);
  }
  bool points() const { return batch > 0 && args.num_radii > 0 && args.num_azimuths > 0; }

  // Calls forward(), with gathers or without: one or the other is faster, which depends on the CPU,
  // on where the pixels come from, and on how many threads ask for them.
  template <typename Forward>
  void sample(Forward forward) {
    const bool possible = current_tier() == Tier::avx512 && !args.packed && args.channels <= 4 &&
                          args.pixel == Pixel::f32 && args.image_stride[3] == 1;
    args.gathers = possible && gathers == Gathers::always;
    if (!possible || gathers != Gathers::measured) return forward();
    constexpr double kLarge = 1 << 19, kTrial = 1 << 16;  // pixels and points
    const double points = static_cast<double>(batch) * static_cast<double>(args.num_radii) *
                          static_cast<double>(args.num_azimuths);
    const bool large = static_cast<double>(args.height) * static_cast<double>(args.width) > kLarge;
    const bool threads = torch::stable::get_num_threads() > 1;
    faster_with_gathers(args.channels == 1, large, threads)(points >= kTrial, [&](bool gather) {
      args.gathers = gather;
      forward();
    });
  }

  // Images that samples are taken of: none if there is no point or no channel.
  int64_t sampled_images() const { return points() && args.channels > 0 ? batch : 0; }
};

// Into how many bands of rows backward cuts an image, so that a small batch of large images uses
// all threads, and a thread never needs much memory for the sums of bfloat16 pixels.
template <typename T>
int64_t count_bands(const PolarCall<T>& call);

// The image's gradient, for backward kernels to fill.
template <typename T>
torch::stable::Tensor new_image_gradient(PolarCall<T>& call);

// Which gradients backward is asked for. Those of radii, center and affine come together.
struct PolarWanted {
  bool image, lens, offsets;
};

// Gradients of the sampling: empty tensors until they are made.
struct PolarGradients {
  torch::stable::Tensor image, radii, center, affine, offsets;

  template <typename T>
  explicit PolarGradients(const PolarCall<T>& call)
      : image(torch::stable::new_empty(call.image, Sizes{0})),
        radii(torch::stable::new_empty(call.radii, Sizes{0})),
        center(torch::stable::new_empty(call.radii, Sizes{0})),
        affine(torch::stable::new_empty(call.radii, Sizes{0})),
        offsets(torch::stable::new_empty(call.radii, Sizes{0})) {}

  auto tuple() const { return std::tuple(image, radii, center, affine, offsets); }
};

// The gradients that are wanted, from args.grad_out.
template <typename T>
PolarGradients polar_backward(PolarCall<T>& call, const PolarWanted& wanted);

// Calls run(call) with a call of the image's type.
template <typename Run>
auto with_polar_call(const Sampling& given, Run run) {
  if (pixel_type(given.image) == Pixel::f64) return run(PolarCall<double>(given));
  return run(PolarCall<float>(given));
}

extern template struct PolarCall<float>;
extern template struct PolarCall<double>;

}  // namespace darswin
