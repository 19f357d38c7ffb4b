// polar_sample and its backward on CPU: allocate, thread, call the kernel.
#include "polar_call.h"

namespace darswin {
namespace {

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
