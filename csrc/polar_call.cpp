#include "polar_call.h"

#include <numeric>

#include "parallel.h"

namespace darswin {

using torch::headeronly::ScalarType;
using torch::stable::Tensor;

template <typename T>
PolarCall<T>::PolarCall(const Tensor& image_, const Tensor& radii_, const Tensor& azimuths_,
                        const Tensor& center_, const Sizes& patch, double jitter,
                        const std::optional<Tensor>& seed, const std::vector<double>& mean,
                        const std::vector<double>& std, bool bfloat16)
    : image(image_),
      radii(torch::stable::contiguous(radii_)),
      center(torch::stable::contiguous(center_)),
      batch(image_.size(0)) {
  const Tensor azimuths = torch::stable::contiguous(azimuths_);
  STD_TORCH_CHECK(image.dim() == 4 && radii.dim() == 2 && azimuths.dim() == 1 &&
                      center.dim() == 2 && center.size(1) == 2 && patch.size() == 2,
                  "polar_sample: wrong number of dimensions");
  STD_TORCH_CHECK((radii.size(0) == 1 || radii.size(0) == batch) &&
                      (center.size(0) == 1 || center.size(0) == batch),
                  "polar_sample: radii and center must have a row an image, or one");
  constexpr ScalarType type = sizeof(T) == sizeof(float) ? ScalarType::Float : ScalarType::Double;
  for (const Tensor* tensor :
       std::initializer_list<const Tensor*>{&this->radii, &azimuths, &this->center}) {
    STD_TORCH_CHECK(tensor->scalar_type() == type && tensor->is_cpu(),
                    "polar_sample: wrong type or device of radii, azimuths or center");
  }
  STD_TORCH_CHECK(patch[0] > 0 && patch[1] > 0 && radii.size(1) % patch[0] == 0 &&
                      azimuths.size(0) % patch[1] == 0,
                  "polar_sample: patch must divide the radii and the azimuths");
  STD_TORCH_CHECK(jitter == 0 || seed.has_value(), "polar_sample: jitter needs a seed");

  args.image = image.const_data_ptr();
  args.pixel = pixel_type(image);
  args.channels = image.size(1);
  args.height = image.size(2);
  args.width = image.size(3);
  for (int axis = 0; axis < 4; ++axis) args.image_stride[axis] = image.stride(axis);
  args.radii = radii.template const_data_ptr<T>();
  args.num_radii = radii.size(1);
  args.radii_stride = radii.size(0) == 1 ? 0 : args.num_radii;
  args.center = center.template const_data_ptr<T>();
  args.center_stride = center.size(0) == 1 ? 0 : 2;
  args.num_azimuths = azimuths.size(0);
  args.patch_radii = patch[0];
  args.patch_azimuths = patch[1];
  args.jitter = jitter;
  args.narrow = bfloat16;
  if (seed.has_value()) {
    STD_TORCH_CHECK(seed->numel() == 1 && seed->scalar_type() == ScalarType::Long,
                    "polar_sample: seed must be one int64");
    args.seed = static_cast<uint64_t>(*seed->const_data_ptr<int64_t>());
  }
  if (args.pixel == Pixel::u8) {
    const size_t channels = static_cast<size_t>(args.channels);
    STD_TORCH_CHECK(mean.size() == channels && std.size() == channels,
                    "polar_sample: uint8 pixels need a mean and a std for each channel");
    for (size_t c = 0; c < channels; ++c) {
      scale.push_back(static_cast<T>(1 / (255 * std[c])));
      offset.push_back(static_cast<T>(-mean[c] / std[c]));
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
  kernels().table<T>().directions(directions.data(), padded, cosines, cosines + padded);
  args.cosines = cosines;
  args.sines = cosines + padded;

  const double pixels = static_cast<double>(args.height) * static_cast<double>(args.width);
  const double points =
      static_cast<double>(args.num_radii) * static_cast<double>(args.num_azimuths);
  args.packed = packed_values() * sizeof(T) <= static_cast<double>(kPackedBytes) &&
                pixels <= kPackedPixelsPerPoint * points;
}

int64_t count_bands(int64_t batch, int64_t height) {
  const int64_t threads = torch::stable::get_num_threads();
  if (batch == 0 || batch >= 4 * threads) return 1;
  return std::clamp<int64_t>(threads / std::gcd(batch, threads), 1, std::max<int64_t>(height, 1));
}

template <typename T>
Tensor new_image_gradient(PolarCall<T>& call) {
  PolarSampleArgs<T>& args = call.args;
  STD_TORCH_CHECK(args.pixel != Pixel::u8, "polar_sample: uint8 pixels have no gradient");
  // Sums of bfloat16 pixels are kept packed whatever the size, and found by 32-bit places.
  STD_TORCH_CHECK(args.pixel != Pixel::bf16 || call.packed_values() < 2147483648.0,
                  "polar_sample_backward: too large an image for a bfloat16 gradient");
  // Where there are points the kernels write every pixel.
  const Tensor grad = call.channels_and_points()
                          ? torch::stable::new_empty(call.image, call.image.sizes())
                          : torch::stable::new_zeros(call.image, call.image.sizes());
  ask_for_large_pages(grad);
  args.grad_image = grad.mutable_data_ptr();
  return grad;
}
template Tensor new_image_gradient(PolarCall<float>&);
template Tensor new_image_gradient(PolarCall<double>&);

namespace {

// From the sums of each row of points to the gradients of radii and center, in a fixed order.
template <typename T>
void fold_lens(const PolarCall<T>& call, const std::vector<double>& sums, Tensor& grad_radii,
               Tensor& grad_center) {
  const int64_t count = call.args.num_radii;
  std::vector<double> radii(grad_radii.numel(), 0.0), center(grad_center.numel(), 0.0);
  for (int64_t b = 0; b < call.batch; ++b) {
    double* row = radii.data() + (call.args.radii_stride == 0 ? 0 : b * count);
    double* xy = center.data() + (call.args.center_stride == 0 ? 0 : b * 2);
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
    }
  }
  std::copy(radii.begin(), radii.end(), grad_radii.template mutable_data_ptr<T>());
  std::copy(center.begin(), center.end(), grad_center.template mutable_data_ptr<T>());
}

}  // namespace

template <typename T>
std::tuple<Tensor, Tensor, Tensor> polar_backward(PolarCall<T>& call, bool image_grad,
                                                  bool lens_grad) {
  PolarSampleArgs<T>& args = call.args;
  const Sizes none = {0};
  const bool points = call.channels_and_points();
  const auto& kernel = kernels().table<T>();

  Tensor grad_image = torch::stable::new_empty(call.image, none);
  if (image_grad) {
    grad_image = new_image_gradient(call);
    args.bands = count_bands(call.batch, args.height);
    const int64_t bytes = kernel.polar_sample_scratch(args);
    parallel_ranges(points ? call.batch * args.bands : 0, [&](int64_t begin, int64_t end, int64_t) {
      kernel.polar_sample_backward_image(args, begin, end, scratch(bytes));
    });
  }
  if (!lens_grad) {
    return {grad_image, torch::stable::new_empty(call.radii, none),
            torch::stable::new_empty(call.center, none)};
  }
  Tensor grad_radii = torch::stable::new_empty(call.radii, call.radii.sizes());
  Tensor grad_center = torch::stable::new_empty(call.center, call.center.sizes());
  std::vector<double> sums(call.batch * args.num_radii * kLensSums, 0.0);
  args.grad_lens = sums.data();
  const int64_t bytes = kernel.polar_sample_scratch(args);
  parallel_ranges(points ? call.batch * call.rings() : 0, [&](int64_t begin, int64_t end, int64_t) {
    kernel.polar_sample_backward_lens(args, begin, end, scratch(bytes));
  });
  fold_lens(call, sums, grad_radii, grad_center);
  return {grad_image, grad_radii, grad_center};
}

template std::tuple<Tensor, Tensor, Tensor> polar_backward(PolarCall<float>&, bool, bool);
template std::tuple<Tensor, Tensor, Tensor> polar_backward(PolarCall<double>&, bool, bool);
template struct PolarCall<float>;
template struct PolarCall<double>;

}  // namespace darswin
