// polar_sample and its backward on CPU: allocate, thread, call the kernel.
#include <torch/csrc/stable/library.h>

#include <algorithm>
#include <optional>
#include <tuple>
#include <vector>

#include "dispatch.h"
#include "parallel.h"
#include "polar_call.h"

namespace darswin {
namespace {

using torch::stable::Tensor;

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

// An image has no tokens, so the driver chooses what the kernels take for one: near, one radius,
// whose samples stay in the nearest cache; far, pieces that are about square, whose points share
// pixels.
template <typename T>
void choose_samples(PolarSampleArgs<T>& args) {
  constexpr int64_t kSide = 16;
  const bool near = args.packed;
  args.samples_r = near ? 1 : largest_divisor(args.num_radii, kSide);
  args.samples_a =
      near ? std::max<int64_t>(args.num_azimuths, 1) : largest_divisor(args.num_azimuths, kSide);
}

template <typename T>
Tensor forward(PolarCall<T>&& call, bool tokens) {
  PolarSampleArgs<T>& args = call.args;
  args.tokens = tokens;
  if (!tokens) choose_samples(args);
  const Tensor out = torch::stable::new_empty(call.radii, output_sizes(call), call.output_type());
  if (out.numel() == 0) return out;
  ask_for_large_pages(out);
  args.out = out.mutable_data_ptr();
  const auto& kernel = kernels<PolarSampleKernels<T>>();
  const int64_t bytes = kernel.scratch(args, PolarPass::forward);
  call.sample([&] {
    parallel_ranges(call.batch * call.rings(), [&](int64_t begin, int64_t end) {
      kernel.forward(args, begin, end, Scratch(bytes).get());
    });
  });
  return out;
}

template <typename T>
auto backward(PolarCall<T>&& call, const Tensor& grad_out_, bool tokens,
              const PolarWanted& wanted) {
  PolarSampleArgs<T>& args = call.args;
  args.tokens = tokens;
  if (!tokens) choose_samples(args);
  // Gradients arrive expanded or strided: `.sum().backward()` gives stride 0.
  const Tensor grad_out = torch::stable::contiguous(grad_out_);
  STD_TORCH_CHECK(
      grad_out.sizes().vec() == output_sizes(call) && grad_out.scalar_type() == call.output_type(),
      "polar_sample_backward: grad_out must look like the output");
  args.grad_out = grad_out.const_data_ptr();
  return polar_backward(call, wanted).tuple();
}

Tensor polar_sample(const Sampling& sampling, bool tokens) {
  return with_polar_call(sampling, [&](auto&& call) { return forward(std::move(call), tokens); });
}

auto polar_sample_backward(const Sampling& sampling, bool tokens, const Tensor& grad_out,
                           bool image_grad, bool lens_grad, bool offsets_grad) {
  return with_polar_call(sampling, [&](auto&& call) {
    return backward(std::move(call), grad_out, tokens, {image_grad, lens_grad, offsets_grad});
  });
}

}  // namespace
}  // namespace darswin

STABLE_TORCH_LIBRARY_IMPL(darswin, CPU, m) {
  using namespace darswin;
  m.impl("polar_sample", TORCH_BOX(&Listed<polar_sample>::call));
  m.impl("polar_sample_backward", TORCH_BOX(&Listed<polar_sample_backward>::call));
}
