// A call of polar_sample or polar_embed, checked and laid out as the kernels take it.
#pragma once

#include <atomic>
#include <tuple>
#include <vector>

#include "checks.h"
#include "polar.h"

namespace darswin {

// The arguments that polar_sample and polar_embed share, in the order of their schemas.
struct Sampling {
  Tensor image, radii, azimuths, center;
  MaybeTensor affine, offsets, jitter, seed;
  Sizes samples;  // (S_r, S_phi)
  std::vector<double> mean, std;
  bool bfloat16;  // the type of the output
};

// Whether far images are read by gathers where that is possible, or as is faster on this CPU.
enum class Gathers { never, always, by_cpu };
extern std::atomic<Gathers> gathers;

// Which gradients backward is asked for. Those of radii, center and affine come together.
struct PolarWanted {
  bool image, lens, offsets;
};

// Gradients of the sampling: empty tensors where they are not wanted.
struct PolarGradients {
  Tensor image, radii, center, affine, offsets;

  auto tuple() const { return std::tuple(image, radii, center, affine, offsets); }
};

// One call's arguments as the kernels take them. Owns what `args` points into.
template <typename T>
struct PolarCall {
  Tensor image, radii, center;
  MaybeTensor affine, offsets;
  std::vector<double> directions;
  std::vector<T> scale, offset;
  PolarSampleArgs<T> args{};
  int64_t batch = 0;

  explicit PolarCall(const Sampling& given);

  int64_t rings() const { return args.num_radii / args.samples_r; }
  int64_t sectors() const { return args.num_azimuths / args.samples_a; }
  int64_t token_size() const { return args.samples_r * args.samples_a * args.channels; }
  ScalarType output_type() const { return args.narrow ? ScalarType::BFloat16 : type_of<T>(); }
  // Images that samples are taken of: none if there is no point or no channel.
  int64_t sampled_images() const { return points() && args.channels > 0 ? batch : 0; }
  bool points() const { return batch > 0 && args.num_radii > 0 && args.num_azimuths > 0; }

  // Into how many bands of rows backward cuts an image, so that a small batch of large images uses
  // all threads, and a thread never needs much memory for the sums of bfloat16 pixels.
  int64_t count_bands() const;
  PolarGradients no_gradients() const;
  // The image's gradient, for backward kernels to fill.
  Tensor new_image_gradient();
  // The gradients that are wanted, from args.grad_out.
  PolarGradients backward(const PolarWanted& wanted);

 private:
  void take_lens();
  void take_jitter(const Sampling& given);
  void take_normalization(const Sampling& given);
  void take_directions(const Tensor& azimuths);
  void choose_reading();
  double packed_values() const;
  void fold_lens(const std::vector<double>& sums, PolarGradients& grads) const;
};

extern template struct PolarCall<float>;
extern template struct PolarCall<double>;

// Listed<run<float>, run<double>>::call is run(PolarCall, others...) as the dispatcher calls it,
// argument by argument, for the type of the image.
template <auto in_float, auto in_double>
struct Listed;
template <typename Result, typename... Others, Result (*in_float)(PolarCall<float>&, Others...),
          Result (*in_double)(PolarCall<double>&, Others...)>
struct Listed<in_float, in_double> {
  static Result call(Tensor image, Tensor radii, Tensor azimuths, Tensor center, MaybeTensor affine,
                     MaybeTensor offsets, MaybeTensor jitter, MaybeTensor seed, Sizes samples,
                     std::vector<double> mean, std::vector<double> std, bool bfloat16,
                     Others... others) {
    const Sampling given{image,  radii, azimuths, center, affine, offsets,
                         jitter, seed,  samples,  mean,   std,    bfloat16};
    if (image.scalar_type() == ScalarType::Double) {
      PolarCall<double> call(given);
      return in_double(call, others...);
    }
    PolarCall<float> call(given);
    return in_float(call, others...);
  }
};

}  // namespace darswin
