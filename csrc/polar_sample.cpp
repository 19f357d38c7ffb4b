// polar_sample and its backward on CPU: check, allocate, thread, call the kernel.
#include <numeric>
#include <tuple>
#include <utility>
#include <vector>

#include "checks.h"
#include "core/dispatch.h"
#include "core/parallel.h"
#include "polar.h"

namespace darswin {
namespace {

// The arguments that polar_sample and its backward share, in the order of their schemas.
struct Sampling {
  Tensor image, radii, azimuths, center;
  MaybeTensor affine, offsets, jitter, seed;
  Sizes samples;  // (S_r, S_phi)
  std::vector<double> mean, std;
  bool bfloat16;  // the type of the output
};

// An image is packed if its copy takes at most this many bytes, so that it stays in the
// second-level cache, and if it has at most this many pixels for each point.
constexpr double kPackedBytes = 3 << 19, kPackedPixels = 4;
// Up to this size (1 MB of float32), CPUs that are not from Intel read gray images faster by
// gathers.
constexpr int64_t kGatheredPixels = 1 << 18;
// bfloat16 pixels have float32 sums of four channels. No thread keeps more bytes of sums than this.
constexpr int64_t kSumsBytes = 24 << 20;

Pixel pixel_type(const Tensor& image) {
  switch (image.scalar_type()) {
    case ScalarType::Float:
      return Pixel::f32;
    case ScalarType::Double:
      return Pixel::f64;
    case ScalarType::BFloat16:
      return Pixel::bf16;
    default:
      STD_TORCH_CHECK(image.scalar_type() == ScalarType::Byte,
                      "polar_sample: pixels must be float32, float64, bfloat16 or uint8");
      return Pixel::u8;
  }
}

// Returns the number in a tensor of one number.
template <typename T>
T single(const Tensor& tensor, ScalarType type, const char* what) {
  STD_TORCH_CHECK(tensor.is_cpu() && tensor.numel() == 1 && tensor.scalar_type() == type,
                  "polar_sample: ", what, " must be one number on the CPU");
  return *pointer<T>(tensor);
}

// The gradients of the sampling. Unwanted gradients are empty tensors.
struct PolarGradients {
  Tensor image, radii, center, affine, offsets;

  auto tuple() const { return std::tuple(image, radii, center, affine, offsets); }
};

// The arguments of one call, as the kernels take them. This object owns the memory that `args`
// points into.
template <typename T>
struct PolarCall {
  Tensor image, radii, center;
  MaybeTensor affine, offsets;
  std::vector<double> directions;
  std::vector<T> scale, offset;
  PolarSampleArgs<T> args{};
  int64_t batch = 0;

  explicit PolarCall(const Sampling& given)
      : image(given.image),
        radii(as_contiguous(given.radii)),
        center(as_contiguous(given.center)),
        affine(as_contiguous(given.affine)),
        offsets(as_contiguous(given.offsets)) {
    const Tensor azimuths = as_contiguous(given.azimuths);
    const Sizes& samples = given.samples;
    STD_TORCH_CHECK(
        image.dim() == 4 && radii.dim() == 2 && azimuths.dim() == 1 && samples.size() == 2,
        "polar_sample: wrong number of dimensions");
    STD_TORCH_CHECK(image.is_cpu() && azimuths.is_cpu() && azimuths.scalar_type() == type_of<T>(),
                    "polar_sample: wrong type or device of image or azimuths");
    STD_TORCH_CHECK(samples[0] > 0 && samples[1] > 0 && radii.size(1) % samples[0] == 0 &&
                        azimuths.size(0) % samples[1] == 0,
                    "polar_sample: samples must divide the radii and the azimuths");
    STD_TORCH_CHECK(sizeof(T) == sizeof(float) || !given.bfloat16,
                    "polar_sample: samples of a float64 image are not rounded to bfloat16");
    batch = image.size(0);
    args.pixel = pixel_type(image);
    args.image = image.const_data_ptr();
    args.channels = image.size(1), args.height = image.size(2), args.width = image.size(3);
    // The stride of an axis of size 1 may be any number, and is never used.
    for (int axis = 0; axis < 4; ++axis) {
      args.image_stride[axis] = image.size(axis) > 1 ? image.stride(axis) : 0;
    }
    args.num_radii = radii.size(1), args.num_azimuths = azimuths.size(0);
    args.samples_r = samples[0], args.samples_a = samples[1];
    args.narrow = given.bfloat16;
    // Later code counts these: points, values of samples, sums of a lens.
    check_product({batch, args.num_radii, args.num_azimuths, args.channels});
    check_product({args.samples_r, args.samples_a, args.channels});
    take_lens();
    take_jitter(given);
    take_normalization(given);
    take_directions(azimuths);
    choose_reading(args.channels);
  }

  int64_t rings() const { return args.num_radii / args.samples_r; }
  int64_t sectors() const { return args.num_azimuths / args.samples_a; }
  int64_t token_size() const { return args.samples_r * args.samples_a * args.channels; }
  ScalarType output_type() const { return args.narrow ? ScalarType::BFloat16 : type_of<T>(); }
  // The number of images that are sampled: none if there is no point or no channel.
  int64_t sampled_images() const { return points() && args.channels > 0 ? batch : 0; }
  bool points() const { return batch > 0 && args.num_radii > 0 && args.num_azimuths > 0; }

  // The estimated time of sampling, which decides how many threads are started.
  double microseconds() const {
    const double points = static_cast<double>(args.num_radii) * args.num_azimuths;
    return sampling_microseconds(batch * points, args.channels);
  }

  // Chooses whether the image is packed, `channels` at a time. If it is not, chooses whether it is
  // read by gathers. docs/performance.md shows the cases in which gathers are faster than loads.
  // For other images they take up to twice as long.
  void choose_reading(int64_t channels) {
    const double pixels = static_cast<double>(args.height) * static_cast<double>(args.width);
    const double points =
        static_cast<double>(args.num_radii) * static_cast<double>(args.num_azimuths);
    // A packed image of 8 bits needs a channel for its coverage.
    args.packed = packed_values(channels) * sizeof(T) <= kPackedBytes &&
                  pixels <= kPackedPixels * points &&
                  (args.pixel != Pixel::u8 || args.channels < 4);
    const bool gray = args.channels == 1;
    const bool possible = current_tier() == Tier::avx512 && !args.packed &&
                          args.pixel == Pixel::f32 && args.image_stride[3] == 1 &&
                          (gray || args.channels == 3);
    args.gathers = possible && (cpu_is_intel() || (gray && pixels <= kGatheredPixels));
  }

  // Returns the number of bands of rows into which backward cuts an image. Bands let a small batch
  // of large images use all threads. They also limit the memory that a thread needs for the sums of
  // bfloat16 pixels.
  int64_t count_bands() const {
    const int64_t threads = threads_for(microseconds());
    int64_t bands = 1;
    if (batch > 0 && batch < 4 * threads) bands = threads / std::gcd(batch, threads);
    if (args.pixel == Pixel::bf16) {
      const double bytes = packed_values(args.channels) * sizeof(T);
      bands = std::max<int64_t>(bands, static_cast<int64_t>(bytes / kSumsBytes) + 1);
    }
    return std::clamp<int64_t>(bands, 1, std::max<int64_t>(args.height, 1));
  }

  PolarGradients no_gradients() const {
    const Tensor of_lens = no_gradient(type_of<T>());
    return {no_gradient(image.scalar_type()), of_lens, of_lens, of_lens, of_lens};
  }

  // Returns a new gradient of the image, which the backward kernels fill.
  Tensor new_image_gradient() {
    STD_TORCH_CHECK(args.pixel != Pixel::u8, "polar_sample: uint8 pixels have no gradient");
    // Sums of bfloat16 pixels are kept in packed form for every size, with 32-bit indices.
    STD_TORCH_CHECK(args.pixel != Pixel::bf16 || packed_values(args.channels) < 2147483648.0,
                    "polar_sample_backward: too large an image for a bfloat16 gradient");
    // If there are points, the kernels write every pixel.
    const Tensor grad =
        points() ? new_tensor(image.sizes(), image.scalar_type()) : new_zeros(image, image.sizes());
    args.grad_image = grad.mutable_data_ptr();
    return grad;
  }

  // Computes the wanted gradients from args.grad_out. Radii, center and affine share one flag.
  PolarGradients backward(bool image_grad, bool lens_grad, bool offsets_grad) {
    const int64_t images = sampled_images();
    const auto& kernel = kernels<PolarSampleKernels<T>>();
    PolarGradients grads = no_gradients();
    if (image_grad) {
      grads.image = new_image_gradient();
      args.bands = count_bands();
      if (images > 0 && grads.image.numel() > 0) {
        run_with_scratch(images * args.bands, threads_for(microseconds()),
                         kernel.scratch(args, PolarPass::backward_image),
                         [&](auto... range) { kernel.backward_image(args, range...); });
      }
    }
    const bool to_offsets = offsets_grad && offsets;
    if (!lens_grad && !to_offsets) return grads;
    if (to_offsets) {
      grads.offsets = new_zeros(*offsets, offsets->sizes());
      args.grad_offsets = mutable_pointer<T>(grads.offsets);
    }
    // Images that share offsets add to one gradient. So one thread takes the same ring of all
    // images, one after the other.
    const int64_t sharing =
        to_offsets && args.offsets_stride == 0 ? std::max<int64_t>(batch, 1) : 1;
    std::vector<double> sums(images * args.num_radii * kLensSums);
    args.grad_lens = sums.data();
    const auto rings_of_images = [&](int64_t begin, int64_t end, void* scratch) {
      for (int64_t ring = begin; ring < end; ++ring) {
        for (int64_t b = 0; b < sharing; ++b) {
          const int64_t item = ring + b * rings();
          kernel.backward_lens(args, item, item + 1, scratch);
        }
      }
    };
    run_with_scratch(images * rings() / sharing, threads_for(microseconds()),
                     kernel.scratch(args, PolarPass::backward_lens), rings_of_images);
    if (lens_grad) fold_lens(sums, grads);
    return grads;
  }

 private:
  void take_lens() {
    const auto take = [&](const Tensor& tensor, const Sizes& sizes, const T*& values,
                          int64_t& stride) {
      const int64_t rows = count_rows<T>(tensor, batch, sizes, "radii, center, affine or offsets");
      values = pointer<T>(tensor);
      stride = rows > 1 ? tensor.numel() / rows : 0;
    };
    take(radii, {args.num_radii}, args.radii, args.radii_stride);
    take(center, {2}, args.center, args.center_stride);
    if (affine) take(*affine, {2, 2}, args.affine, args.affine_stride);
    if (!offsets) return;
    take(*offsets, {2, args.num_radii, args.num_azimuths}, args.offsets, args.offsets_stride);
    args.offsets_end = args.offsets + offsets->numel();
  }

  void take_jitter(const Sampling& given) {
    if (given.jitter) {
      STD_TORCH_CHECK(given.seed.has_value(), "polar_sample: jitter needs a seed");
      args.jitter = single<double>(*given.jitter, ScalarType::Double, "jitter, a float64,");
      STD_TORCH_CHECK(args.jitter >= 0 && args.jitter <= 1,
                      "polar_sample: jitter must be in [0, 1]");
    }
    if (given.seed) {
      args.seed = single<uint64_t>(*given.seed, ScalarType::Long, "seed, an int64,");
    }
  }

  // A uint8 pixel p has the value (p / 255 - mean) / std.
  void take_normalization(const Sampling& given) {
    if (args.pixel != Pixel::u8) return;
    const size_t channels = static_cast<size_t>(args.channels);
    STD_TORCH_CHECK(given.mean.size() == channels && given.std.size() == channels,
                    "polar_sample: uint8 pixels need a mean and a std for each channel");
    for (size_t c = 0; c < channels; ++c) {
      scale.push_back(static_cast<T>(1 / (255 * given.std[c])));
      offset.push_back(static_cast<T>(-given.mean[c] / given.std[c]));
    }
    scale.resize(channels + 3), offset.resize(channels + 3);
    args.pixel_scale = scale.data();
    args.pixel_offset = offset.data();
  }

  // Stores angles, cosines and sines, each padded to whole registers.
  void take_directions(const Tensor& azimuths) {
    const int64_t padded = (args.num_azimuths + 15) / 8 * 8;
    directions.assign(3 * padded, 0.0);
    std::copy_n(pointer<T>(azimuths), args.num_azimuths, directions.begin());
    double* cosines = directions.data() + padded;
    kernels<PolarSampleKernels<T>>().directions(directions.data(), padded, cosines,
                                                cosines + padded);
    args.cosines = cosines;
    args.sines = cosines + padded;
    args.directions_finite =
        std::all_of(cosines, cosines + args.num_azimuths, [](double x) { return x == x; });
  }

  // Returns the number of values in the kernels' packed image of so many channels. It is a double,
  // because it may not fit 64 bits.
  double packed_values(int64_t channels) const {
    return static_cast<double>(args.height + 3) * static_cast<double>(args.width + 3) *
           static_cast<double>(round_up(channels, 4));
  }

  // Adds up the sums of each row of points into the gradients of radii, center and affine.
  void fold_lens(const std::vector<double>& sums, PolarGradients& grads) const {
    const int64_t count = args.num_radii;
    std::vector<double> of_radii(radii.numel()), of_center(center.numel());
    std::vector<double> of_affine(affine ? affine->numel() : 0);
    for (int64_t b = 0; b < sampled_images(); ++b) {
      double* row = of_radii.data() + b * args.radii_stride;
      double* xy = of_center.data() + b * args.center_stride;
      double* matrix = of_affine.data() + b * args.affine_stride;
      for (int64_t i = 0; i < count; ++i) {
        const double* sum = sums.data() + (b * count + i) * kLensSums;
        const Steps steps(i, count);
        row[i] += sum[kAlong];
        for (int side = 0; side < 2; ++side) {
          row[steps.above[side]] += sum[kInward + side];
          row[steps.below[side]] -= sum[kInward + side];
        }
        xy[0] += sum[kAcross];
        xy[1] += sum[kDown];
        for (int e = 0; e < 4 && affine; ++e) matrix[e] += sum[kAffine + e];
      }
    }
    grads.radii = rounded_like<T>(radii, of_radii);
    grads.center = rounded_like<T>(center, of_center);
    if (affine) grads.affine = rounded_like<T>(*affine, of_affine);
  }
};

// Makes a function with the dispatcher's list of arguments: Listed<run<float>, run<double>>::call.
// It calls run(PolarCall, others...) for the type of the image.
template <auto in_float, auto in_double>
struct Listed;
template <typename Result, typename... Others, Result (*in_float)(PolarCall<float>&, Others...),
          Result (*in_double)(PolarCall<double>&, Others...)>
struct Listed<in_float, in_double> {
  static Result call(Tensor image, Tensor radii, Tensor azimuths, Tensor center, MaybeTensor affine,
                     MaybeTensor offsets, MaybeTensor jitter, MaybeTensor seed, Sizes samples,
                     std::vector<double> mean, std::vector<double> std, bool bfloat16,
                     Others... others) {
    const Sampling given{std::move(image),  std::move(radii),  std::move(azimuths),
                         std::move(center), std::move(affine), std::move(offsets),
                         std::move(jitter), std::move(seed),   std::move(samples),
                         std::move(mean),   std::move(std),    bfloat16};
    if (given.image.scalar_type() == ScalarType::Double) {
      PolarCall<double> call(given);
      return in_double(call, others...);
    }
    PolarCall<float> call(given);
    return in_float(call, others...);
  }
};

template <typename T>
Sizes output_sizes(const PolarCall<T>& call) {
  const PolarSampleArgs<T>& args = call.args;
  if (!args.tokens) return {call.batch, args.channels, args.num_radii, args.num_azimuths};
  return {call.batch, call.rings(), call.sectors(), call.token_size()};
}

int64_t largest_divisor(int64_t number, int64_t most) {
  int64_t divisor = std::clamp<int64_t>(number, 1, most);
  while (number % divisor != 0) --divisor;
  return divisor;
}

// An image has no tokens, so the driver chooses the pieces that the kernels treat as tokens. For a
// packed image, a piece is one radius, whose samples stay in the first-level cache. For an image
// that is read directly, pieces are about square, so that their points share pixels.
template <typename T>
void choose_layout(PolarSampleArgs<T>& args, bool tokens) {
  constexpr int64_t kSide = 16;
  args.tokens = tokens;
  if (tokens) return;
  const bool packed = args.packed;
  args.samples_r = packed ? 1 : largest_divisor(args.num_radii, kSide);
  args.samples_a =
      packed ? std::max<int64_t>(args.num_azimuths, 1) : largest_divisor(args.num_azimuths, kSide);
}

template <typename T>
Tensor forward(PolarCall<T>& call, bool tokens) {
  PolarSampleArgs<T>& args = call.args;
  if (!tokens) call.choose_reading(4);  // planes are packed by fours
  choose_layout(args, tokens);
  const Tensor out = new_tensor(output_sizes(call), call.output_type());
  if (out.numel() == 0) return out;
  args.out = out.mutable_data_ptr();
  const auto& kernel = kernels<PolarSampleKernels<T>>();
  run_with_scratch(call.batch * call.rings(), threads_for(call.microseconds()),
                   kernel.scratch(args, PolarPass::forward),
                   [&](auto... range) { kernel.forward(args, range...); });
  return out;
}

template <typename T>
auto backward(PolarCall<T>& call, bool tokens, Tensor grad, bool image_grad, bool lens_grad,
              bool offsets_grad) {
  const TorchThreads in_training;
  choose_layout(call.args, tokens);
  grad = checked_gradient(grad, output_sizes(call), call.output_type(), "polar_sample");
  call.args.grad_out = grad.const_data_ptr();
  return call.backward(image_grad, lens_grad, offsets_grad).tuple();
}

using Forward = Listed<forward<float>, forward<double>>;
using Backward = Listed<backward<float>, backward<double>>;

}  // namespace
}  // namespace darswin

STABLE_TORCH_LIBRARY_IMPL(darswin, CPU, m) {
  m.impl("polar_sample", TORCH_BOX(&darswin::Forward::call));
  m.impl("polar_sample_backward", TORCH_BOX(&darswin::Backward::call));
}
