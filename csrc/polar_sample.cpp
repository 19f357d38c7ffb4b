// polar_sample and its backward on CPU: check, allocate, thread, call the kernel.
// The checks here only keep memory safe; darswin/ops/polar_sample.py explains wrong arguments.
#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/ops.h>
#include <torch/csrc/stable/tensor.h>
#include <torch/headeronly/util/Exception.h>

#include <cmath>
#include <optional>
#include <tuple>
#include <vector>

#include "dispatch.h"
#include "parallel.h"

namespace darswin {
namespace {

using torch::headeronly::ScalarType;
using torch::stable::Tensor;
using Sizes = std::vector<int64_t>;

// The arguments of one call, contiguous where the kernels want it. Owns what `args` points into.
template <typename T>
struct Call {
  Tensor image, radii, azimuths, center;
  std::vector<double> cosines, sines;
  PolarSampleArgs<T> args{};
  int64_t batch;

  Call(const Tensor& image_, const Tensor& radii_, const Tensor& azimuths_, const Tensor& center_,
       const Sizes& patch, double jitter, const std::optional<Tensor>& seed, bool tokens)
      : image(image_),
        radii(torch::stable::contiguous(radii_)),
        azimuths(torch::stable::contiguous(azimuths_)),
        center(torch::stable::contiguous(center_)),
        batch(image_.size(0)) {
    STD_TORCH_CHECK(image.dim() == 4 && radii.dim() == 2 && azimuths.dim() == 1 &&
                        center.dim() == 2 && center.size(1) == 2 && patch.size() == 2,
                    "polar_sample: wrong number of dimensions");
    STD_TORCH_CHECK((radii.size(0) == 1 || radii.size(0) == batch) &&
                        (center.size(0) == 1 || center.size(0) == batch),
                    "polar_sample: radii and center must have a row an image, or one");
    for (const Tensor* tensor : {&radii, &azimuths, &center}) {
      STD_TORCH_CHECK(tensor->scalar_type() == image.scalar_type() && tensor->is_cpu(),
                      "polar_sample: all tensors must be on the CPU and have the image's type");
    }
    STD_TORCH_CHECK(patch[0] > 0 && patch[1] > 0 && radii.size(1) % patch[0] == 0 &&
                        azimuths.size(0) % patch[1] == 0,
                    "polar_sample: patch must divide the radii and the azimuths");
    STD_TORCH_CHECK(jitter == 0 || seed.has_value(), "polar_sample: jitter needs a seed");

    args.image = image.template const_data_ptr<T>();
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
    args.tokens = tokens;
    args.jitter = jitter;
    if (seed.has_value()) {
      STD_TORCH_CHECK(seed->numel() == 1 && seed->scalar_type() == ScalarType::Long,
                      "polar_sample: seed must be one int64");
      args.seed = static_cast<uint64_t>(*seed->const_data_ptr<int64_t>());
    }
    const T* angles = azimuths.template const_data_ptr<T>();
    for (int64_t j = 0; j < args.num_azimuths; ++j) {
      cosines.push_back(std::cos(static_cast<double>(angles[j])));
      sines.push_back(std::sin(static_cast<double>(angles[j])));
    }
    args.cosines = cosines.data();
    args.sines = sines.data();
  }

  Sizes output_sizes() const {
    const int64_t samples = args.patch_radii * args.patch_azimuths;
    if (!args.tokens) return {batch, args.channels, args.num_radii, args.num_azimuths};
    return {batch, args.num_radii / args.patch_radii, args.num_azimuths / args.patch_azimuths,
            samples * args.channels};
  }
};

template <typename T>
Tensor forward(Call<T>&& call) {
  const Tensor out = torch::stable::new_empty(call.image, call.output_sizes());
  if (out.numel() == 0) return out;
  call.args.out = out.template mutable_data_ptr<T>();
  parallel_ranges(call.batch * call.args.num_radii, [&](int64_t begin, int64_t end, int64_t) {
    kernels().table<T>().polar_sample(call.args, begin, end);
  });
  return out;
}

template <typename T>
std::tuple<Tensor, Tensor, Tensor> backward(Call<T>&& call, const Tensor& grad_out_,
                                            bool image_grad, bool lens_grad) {
  // Gradients arrive expanded or strided: `.sum().backward()` gives stride 0.
  const Tensor grad_out = torch::stable::contiguous(grad_out_);
  STD_TORCH_CHECK(grad_out.sizes().vec() == call.output_sizes() &&
                      grad_out.scalar_type() == call.image.scalar_type(),
                  "polar_sample_backward: grad_out must look like the output");
  const Sizes none = {0};  // what is not wanted comes back empty
  const Tensor grad_image = torch::stable::new_zeros(
      call.image, image_grad ? call.image.sizes() : torch::headeronly::IntHeaderOnlyArrayRef(none));
  std::vector<double> radii_rows, center_rows;
  call.args.grad_out = grad_out.template const_data_ptr<T>();
  if (image_grad) call.args.grad_image = grad_image.template mutable_data_ptr<T>();
  if (lens_grad) {
    radii_rows.assign(call.batch * call.args.num_radii, 0.0);
    center_rows.assign(call.batch * 2, 0.0);
    call.args.grad_radii = radii_rows.data();
    call.args.grad_center = center_rows.data();
  }
  if (grad_out.numel() > 0) {
    parallel_ranges(call.batch, [&](int64_t begin, int64_t end, int64_t) {
      kernels().table<T>().polar_sample_backward(call.args, begin, end);
    });
  }
  if (!lens_grad) {
    return {grad_image, torch::stable::new_empty(call.radii, none),
            torch::stable::new_empty(call.center, none)};
  }
  return {grad_image, fold_rows<T>(call.radii, radii_rows), fold_rows<T>(call.center, center_rows)};
}

Tensor polar_sample(const Tensor& image, const Tensor& radii, const Tensor& azimuths,
                    const Tensor& center, Sizes patch, double jitter, std::optional<Tensor> seed,
                    bool tokens) {
  if (image.scalar_type() == ScalarType::Float) {
    return forward(Call<float>(image, radii, azimuths, center, patch, jitter, seed, tokens));
  }
  STD_TORCH_CHECK(image.scalar_type() == ScalarType::Double, "polar_sample: float32 or float64");
  return forward(Call<double>(image, radii, azimuths, center, patch, jitter, seed, tokens));
}

std::tuple<Tensor, Tensor, Tensor> polar_sample_backward(
    const Tensor& grad_out, const Tensor& image_, const Tensor& radii, const Tensor& azimuths,
    const Tensor& center, Sizes patch, double jitter, std::optional<Tensor> seed, bool tokens,
    bool image_grad, bool lens_grad) {
  const Tensor image = torch::stable::contiguous(image_);
  if (image.scalar_type() == ScalarType::Float) {
    return backward(Call<float>(image, radii, azimuths, center, patch, jitter, seed, tokens),
                    grad_out, image_grad, lens_grad);
  }
  STD_TORCH_CHECK(image.scalar_type() == ScalarType::Double, "polar_sample: float32 or float64");
  return backward(Call<double>(image, radii, azimuths, center, patch, jitter, seed, tokens),
                  grad_out, image_grad, lens_grad);
}

}  // namespace
}  // namespace darswin

STABLE_TORCH_LIBRARY_IMPL(darswin, CPU, m) {
  m.impl("polar_sample", TORCH_BOX(&darswin::polar_sample));
  m.impl("polar_sample_backward", TORCH_BOX(&darswin::polar_sample_backward));
}
