#include "polar_call.h"

#include <algorithm>
#include <numeric>

#include "dispatch.h"
#include "parallel.h"

namespace darswin {

using torch::headeronly::ScalarType;
using torch::stable::Tensor;

void check_product(std::initializer_list<int64_t> sizes) {
  int64_t result = 64;
  for (const int64_t size : sizes) {
    STD_TORCH_CHECK(size == 0 || !__builtin_mul_overflow(result, size, &result),
                    "the sizes are too large");
  }
}

template <typename T>
PolarCall<T>::PolarCall(const Sampling& given)
    : image(given.image),
      radii(torch::stable::contiguous(given.radii)),
      center(torch::stable::contiguous(given.center)),
      batch(image.dim() == 4 ? image.size(0) : 0) {
  const Tensor azimuths = torch::stable::contiguous(given.azimuths);
  const Sizes& samples = given.samples;
  STD_TORCH_CHECK(image.dim() == 4 && radii.dim() == 2 && azimuths.dim() == 1 &&
                      center.dim() == 2 && center.size(1) == 2 && samples.size() == 2,
                  "polar_sample: wrong number of dimensions");
  STD_TORCH_CHECK(image.is_cpu(), "polar_sample: the image must be on the CPU");
  STD_TORCH_CHECK((radii.size(0) == 1 || radii.size(0) == batch) &&
                      (center.size(0) == 1 || center.size(0) == batch),
                  "polar_sample: radii and center must have a row an image, or one");
  constexpr ScalarType type = sizeof(T) == sizeof(float) ? ScalarType::Float : ScalarType::Double;
  for (const Tensor* tensor : std::initializer_list<const Tensor*>{&radii, &azimuths, &center}) {
    STD_TORCH_CHECK(tensor->scalar_type() == type && tensor->is_cpu(),
                    "polar_sample: wrong type or device of radii, azimuths or center");
  }
  STD_TORCH_CHECK(samples[0] > 0 && samples[1] > 0 && radii.size(1) % samples[0] == 0 &&
                      azimuths.size(0) % samples[1] == 0,
                  "polar_sample: samples must divide the radii and the azimuths");
  // What is counted below: points, values of samples, sums of a lens.
  check_product({batch, radii.size(1), azimuths.size(0), image.size(1)});
  check_product({samples[0], samples[1], image.size(1)});
  const auto laid_out = [&](const Tensor& tensor, Sizes sizes) {
    sizes[0] = tensor.dim() > 0 && tensor.size(0) == 1 ? 1 : batch;
    STD_TORCH_CHECK(
        tensor.scalar_type() == type && tensor.is_cpu() && tensor.sizes().vec() == sizes,
        "polar_sample: wrong type, device or shape of affine or offsets");
    return torch::stable::contiguous(tensor);
  };
  if (given.affine.has_value()) {
    affine = laid_out(*given.affine, {batch, 2, 2});
    args.affine = affine->template const_data_ptr<T>();
    args.affine_stride = affine->size(0) == 1 ? 0 : 4;
  }
  if (given.offsets.has_value()) {
    offsets = laid_out(*given.offsets, {batch, 2, radii.size(1), azimuths.size(0)});
    args.offsets = offsets->template const_data_ptr<T>();
    args.offsets_end = args.offsets + offsets->numel();
    args.offsets_stride = offsets->size(0) == 1 ? 0 : 2 * radii.size(1) * azimuths.size(0);
  }
  STD_TORCH_CHECK(!given.jitter.has_value() || given.seed.has_value(),
                  "polar_sample: jitter needs a seed");
  STD_TORCH_CHECK(type == ScalarType::Float || !given.bfloat16,
                  "polar_sample: samples of a float64 image are not rounded to bfloat16");

  args.image = image.const_data_ptr();
  args.pixel = pixel_type(image);
  args.channels = image.size(1);
  args.height = image.size(2);
  args.width = image.size(3);
  // The stride of a single row or column may be any number, and is never used.
  for (int axis = 0; axis < 4; ++axis) {
    args.image_stride[axis] = image.size(axis) > 1 ? image.stride(axis) : 0;
  }
  args.radii = radii.template const_data_ptr<T>();
  args.num_radii = radii.size(1);
  args.radii_stride = radii.size(0) == 1 ? 0 : args.num_radii;
  args.center = center.template const_data_ptr<T>();
  args.center_stride = center.size(0) == 1 ? 0 : 2;
  args.num_azimuths = azimuths.size(0);
  args.samples_r = samples[0];
  args.samples_a = samples[1];
  args.narrow = given.bfloat16;
  if (given.jitter.has_value()) {
    STD_TORCH_CHECK(given.jitter->is_cpu() && given.jitter->numel() == 1 &&
                        given.jitter->scalar_type() == ScalarType::Double,
                    "polar_sample: jitter must be one float64 on the CPU");
    args.jitter = *given.jitter->const_data_ptr<double>();
    STD_TORCH_CHECK(args.jitter >= 0 && args.jitter <= 1, "polar_sample: jitter must be in [0, 1]");
  }
  if (given.seed.has_value()) {
    STD_TORCH_CHECK(given.seed->is_cpu() && given.seed->numel() == 1 &&
                        given.seed->scalar_type() == ScalarType::Long,
                    "polar_sample: seed must be one int64 on the CPU");
    args.seed = static_cast<uint64_t>(*given.seed->const_data_ptr<int64_t>());
  }
  if (args.pixel == Pixel::u8) {
    const size_t channels = static_cast<size_t>(args.channels);
    STD_TORCH_CHECK(given.mean.size() == channels && given.std.size() == channels,
                    "polar_sample: uint8 pixels need a mean and a std for each channel");
    for (size_t c = 0; c < channels; ++c) {
      scale.push_back(static_cast<T>(1 / (255 * given.std[c])));
      offset.push_back(static_cast<T>(-given.mean[c] / given.std[c]));
    }
    args.pixel_scale = scale.data();
    args.pixel_offset = offset.data();
  }

  // Angles, cosines, sines, each padded for whole registers.
  const int64_t padded = (args.num_azimuths + 15) / 8 * 8;
  directions.assign(3 * padded, 0.0);
  const T* angles = azimuths.template const_data_ptr<T>();
  for (int64_t j = 0; j < args.num_azimuths; ++j) directions[j] = angles[j];
  double* cosines = directions.data() + padded;
  kernels<PolarSampleKernels<T>>().directions(directions.data(), padded, cosines, cosines + padded);
  args.cosines = cosines;
  args.sines = cosines + padded;
  args.directions_finite =
      std::all_of(cosines, cosines + args.num_azimuths, [](double x) { return x == x; });

  const double pixels = static_cast<double>(args.height) * static_cast<double>(args.width);
  const double points =
      static_cast<double>(args.num_radii) * static_cast<double>(args.num_azimuths);
  args.packed = packed_values() * sizeof(T) <= static_cast<double>(kPackedBytes) &&
                pixels <= kPackedPixelsPerPoint * points;
}

std::atomic<Gathers> gathers{Gathers::measured};

Faster& faster_with_gathers(bool gray, bool large, bool threads) {
  static Faster all[2][2][2];
  return all[gray][large][threads];
}

template <typename T>
int64_t count_bands(const PolarCall<T>& call) {
  const int64_t threads = torch::stable::get_num_threads(), height = call.args.height;
  int64_t bands = 1;
  if (call.batch > 0 && call.batch < 4 * threads) bands = threads / std::gcd(call.batch, threads);
  if (call.args.pixel == Pixel::bf16) {
    const double bytes = call.packed_values() * sizeof(T);
    bands = std::max<int64_t>(bands, static_cast<int64_t>(bytes / kSumsBytes) + 1);
  }
  return std::clamp<int64_t>(bands, 1, std::max<int64_t>(height, 1));
}
template int64_t count_bands(const PolarCall<float>&);
template int64_t count_bands(const PolarCall<double>&);

template <typename T>
Tensor new_image_gradient(PolarCall<T>& call) {
  PolarSampleArgs<T>& args = call.args;
  STD_TORCH_CHECK(args.pixel != Pixel::u8, "polar_sample: uint8 pixels have no gradient");
  // Sums of bfloat16 pixels are kept packed whatever the size, and indexed with 32 bits.
  STD_TORCH_CHECK(args.pixel != Pixel::bf16 || call.packed_values() < 2147483648.0,
                  "polar_sample_backward: too large an image for a bfloat16 gradient");
  // Where there are points the kernels write every pixel.
  const Tensor grad = call.points() ? torch::stable::new_empty(call.image, call.image.sizes())
                                    : torch::stable::new_zeros(call.image, call.image.sizes());
  ask_for_large_pages(grad);
  args.grad_image = grad.mutable_data_ptr();
  return grad;
}
template Tensor new_image_gradient(PolarCall<float>&);
template Tensor new_image_gradient(PolarCall<double>&);

namespace {

// The gradient of `like`, (B or 1, ...), from doubles that were added up in a fixed order.
template <typename T>
Tensor rounded_like(const Tensor& like, const std::vector<double>& sums) {
  const Tensor grad = torch::stable::new_empty(like, like.sizes());
  std::copy(sums.begin(), sums.end(), grad.template mutable_data_ptr<T>());
  return grad;
}

// From the sums of each row of points to the gradients of radii, center and affine.
template <typename T>
void fold_lens(const PolarCall<T>& call, const std::vector<double>& sums, PolarGradients& grads) {
  const int64_t count = call.args.num_radii;
  std::vector<double> radii(call.radii.numel(), 0.0), center(call.center.numel(), 0.0);
  std::vector<double> affine(call.affine.has_value() ? call.affine->numel() : 0, 0.0);
  for (int64_t b = 0; b < call.batch; ++b) {
    double* row = radii.data() + b * call.args.radii_stride;
    double* xy = center.data() + b * call.args.center_stride;
    double* matrix = affine.data() + b * call.args.affine_stride;
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
      for (int e = 0; e < 4 && call.affine.has_value(); ++e) matrix[e] += sum[kAffine + e];
    }
  }
  grads.radii = rounded_like<T>(call.radii, radii);
  grads.center = rounded_like<T>(call.center, center);
  if (call.affine.has_value()) grads.affine = rounded_like<T>(*call.affine, affine);
}

}  // namespace

template <typename T>
PolarGradients polar_backward(PolarCall<T>& call, const PolarWanted& wanted) {
  PolarSampleArgs<T>& args = call.args;
  const int64_t images = call.sampled_images();
  const auto& kernel = kernels<PolarSampleKernels<T>>();

  PolarGradients grads(call);
  if (wanted.image) {
    grads.image = new_image_gradient(call);
    args.bands = count_bands(call);
    if (images > 0 && grads.image.numel() > 0) {
      const int64_t bytes = kernel.scratch(args, PolarPass::backward_image);
      parallel_ranges(images * args.bands, [&](int64_t begin, int64_t end) {
        kernel.backward_image(args, begin, end, Scratch(bytes).get());
      });
    }
  }
  if (!wanted.lens && !wanted.offsets) return grads;
  const bool offsets = wanted.offsets && call.offsets.has_value();
  if (offsets) {
    grads.offsets = torch::stable::new_zeros(*call.offsets, call.offsets->sizes());
    args.grad_offsets = grads.offsets.template mutable_data_ptr<T>();
  }
  if (images == 0) {
    if (wanted.lens) {
      grads.radii = torch::stable::new_zeros(call.radii, call.radii.sizes());
      grads.center = torch::stable::new_zeros(call.center, call.center.sizes());
      if (call.affine.has_value()) {
        grads.affine = torch::stable::new_zeros(*call.affine, call.affine->sizes());
      }
    }
    return grads;
  }
  // Images that share their offsets add to one gradient, so one thread takes a ring of all images,
  // one after another.
  const int64_t sharing = offsets && args.offsets_stride == 0 ? call.batch : 1;
  std::vector<double> sums(call.batch * args.num_radii * kLensSums, 0.0);
  args.grad_lens = sums.data();
  const int64_t rings = call.rings();
  const int64_t bytes = kernel.scratch(args, PolarPass::backward_lens);
  parallel_ranges(images * rings / sharing, [&](int64_t begin, int64_t end) {
    const Scratch scratch(bytes);
    for (int64_t item = begin; item < end; ++item) {
      for (int64_t b = 0; b < sharing; ++b) {
        const int64_t of_image = item + b * rings;
        kernel.backward_lens(args, of_image, of_image + 1, scratch.get());
      }
    }
  });
  if (wanted.lens) fold_lens(call, sums, grads);
  return grads;
}

template PolarGradients polar_backward(PolarCall<float>&, const PolarWanted&);
template PolarGradients polar_backward(PolarCall<double>&, const PolarWanted&);
template struct PolarCall<float>;
template struct PolarCall<double>;

}  // namespace darswin
