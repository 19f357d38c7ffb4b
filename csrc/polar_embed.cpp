// polar_embed and its backward on CPU: allocate, thread, call the kernel.
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

int64_t padded(int64_t n) { return (n + kRowUnit - 1) / kRowUnit * kRowUnit; }

// A weight (D, S_r * S_phi * C) or a bias (D,), contiguous and in the type that is computed in.
template <typename T>
Tensor parameter(const PolarCall<T>& call, const Tensor& value) {
  STD_TORCH_CHECK(value.is_cpu(), "polar_embed: weight and bias must be on the CPU");
  return torch::stable::contiguous(torch::stable::to(value, call.radii.scalar_type()));
}

template <typename T>
void check_weight(const PolarCall<T>& call, const Tensor& weight) {
  STD_TORCH_CHECK(weight.dim() == 2 && weight.size(1) == call.token_size(),
                  "polar_embed: weight does not fit the samples of a token");
}

template <typename T>
Sizes output_sizes(const PolarCall<T>& call, int64_t features) {
  return {call.batch, call.rings(), call.sectors(), features};
}

template <typename T>
Tensor forward(PolarCall<T>&& call, const Tensor& weight_, const std::optional<Tensor>& bias_) {
  check_weight(call, weight_);
  const Tensor weight = parameter(call, weight_);
  const auto& kernel = kernels<PolarEmbedKernels<T>>();
  PolarSampleArgs<T>& args = call.args;
  args.tokens = true;
  PolarEmbedArgs<T> embed{};
  embed.features = weight.size(0);
  const Tensor bias = bias_.has_value() ? parameter(call, *bias_) : weight;
  if (bias_.has_value()) {
    STD_TORCH_CHECK(bias.dim() == 1 && bias.size(0) == embed.features,
                    "polar_embed: bias does not fit the weight");
    embed.bias = bias.template const_data_ptr<T>();
  }
  const Tensor out =
      torch::stable::new_empty(call.radii, output_sizes(call, embed.features), call.output_type());
  if (out.numel() == 0) return out;
  args.out = out.mutable_data_ptr();
  const int64_t wide = padded(embed.features);
  std::vector<T> transposed(call.token_size() * wide);
  kernel.transpose(weight.template const_data_ptr<T>(), embed.features, call.token_size(),
                   transposed.data(), wide);
  embed.transposed = transposed.data();
  const int64_t bytes = kernel.scratch(args, embed, PolarPass::forward);
  call.sample([&] {
    parallel_ranges(call.batch * call.rings(), [&](int64_t begin, int64_t end) {
      kernel.forward(args, embed, begin, end, Scratch(bytes).get());
    });
  });
  return out;
}

// How many tokens are summed one by one. Longer sums add up such partial sums, since the rounding
// of a sum grows with its length.
constexpr int64_t kRunTokens = 1024;

// Adds the weight's gradient from items [begin, end) to `weight`, (D, padded samples), and the
// bias's to `bias`, (D,).
template <typename T>
void add_weight_gradient(const PolarCall<T>& call, const PolarEmbedArgs<T>& embed, int64_t begin,
                         int64_t end, T* weight, double* bias, void* scratch) {
  const auto& kernel = kernels<PolarEmbedKernels<T>>();
  const int64_t run = std::max<int64_t>(1, kRunTokens / call.sectors());
  if (end - begin <= run) {
    kernel.backward_weight(call.args, embed, begin, end, weight, bias, scratch);
    return;
  }
  std::vector<T> part(embed.features * padded(call.token_size()));
  for (int64_t first = begin; first < end; first += run) {
    std::fill(part.begin(), part.end(), T(0));
    const int64_t last = std::min(first + run, end);
    kernel.backward_weight(call.args, embed, first, last, part.data(), bias, scratch);
    for (size_t k = 0; k < part.size(); ++k) weight[k] += part[k];
  }
}

// Gradients of weight and bias. Each chunk of items has sums of its own, which are then added up in
// order. The number of chunks does not depend on that of the threads, so the result does not
// either.
template <typename T>
std::tuple<Tensor, Tensor> weight_gradients(const PolarCall<T>& call,
                                            const PolarEmbedArgs<T>& embed) {
  const int64_t depth = call.token_size(), row = padded(depth), features = embed.features;
  const int64_t items = call.points() ? call.batch * call.rings() : 0;
  const int64_t chunks = std::min<int64_t>(items, 16);
  std::vector<T> weights(chunks * features * row, T(0));
  std::vector<double> biases(chunks * features, 0.0);
  const int64_t bytes =
      chunks > 0 ? kernels<PolarEmbedKernels<T>>().scratch(call.args, embed, PolarPass::forward)
                 : 0;
  parallel_ranges(chunks, [&](int64_t begin, int64_t end) {
    const Scratch scratch(bytes);
    for (int64_t chunk = begin; chunk < end; ++chunk) {
      add_weight_gradient(call, embed, items * chunk / chunks, items * (chunk + 1) / chunks,
                          weights.data() + chunk * features * row, biases.data() + chunk * features,
                          scratch.get());
    }
  });
  const Tensor weight = torch::stable::new_empty(call.radii, Sizes{features, depth});
  const Tensor bias = torch::stable::new_empty(call.radii, Sizes{features});
  T *to_weight = weight.template mutable_data_ptr<T>(),
    *to_bias = bias.template mutable_data_ptr<T>();
  parallel_ranges(features, [&](int64_t begin, int64_t end) {
    for (int64_t f = begin; f < end; ++f) {
      double sum = 0;
      for (int64_t k = 0; k < depth; ++k) to_weight[f * depth + k] = 0;
      for (int64_t chunk = 0; chunk < chunks; ++chunk) {
        const T* from = weights.data() + (chunk * features + f) * row;
        for (int64_t k = 0; k < depth; ++k) to_weight[f * depth + k] += from[k];
        sum += biases[chunk * features + f];
      }
      to_bias[f] = static_cast<T>(sum);
    }
  });
  return {weight, bias};
}

// Gradients of image and lens, through those of the samples.
template <typename T>
PolarGradients sampling_gradients(PolarCall<T>& call, PolarEmbedArgs<T>& embed,
                                  const Tensor& weight, const PolarWanted& wanted) {
  const auto& kernel = kernels<PolarEmbedKernels<T>>();
  const int64_t depth = call.token_size(), row = padded(depth);
  const int64_t images = call.sampled_images();
  std::vector<T> rows(images > 0 ? embed.features * row : 0, T(0));
  const T* from = weight.template const_data_ptr<T>();
  for (int64_t f = 0; images > 0 && f < embed.features; ++f) {
    std::copy(from + f * depth, from + (f + 1) * depth, rows.begin() + f * row);
  }
  embed.weight = rows.data();
  const bool image_alone = !wanted.lens && !wanted.offsets;
  if (image_alone && count_bands(call) == 1) {
    PolarGradients grads(call);
    grads.image = new_image_gradient(call);
    call.args.bands = 1;
    if (images > 0 && grads.image.numel() > 0) {
      const int64_t bytes = kernel.scratch(call.args, embed, PolarPass::backward_image);
      parallel_ranges(images, [&](int64_t begin, int64_t end) {
        kernel.backward_image(call.args, embed, begin, end, Scratch(bytes).get());
      });
    }
    return grads;
  }
  const Tensor grad_samples = torch::stable::new_empty(call.radii, output_sizes(call, depth));
  embed.grad_samples = grad_samples.template mutable_data_ptr<T>();
  if (images > 0) {
    const int64_t bytes = kernel.scratch(call.args, embed, PolarPass::backward_samples);
    parallel_ranges(images * call.rings(), [&](int64_t begin, int64_t end) {
      kernel.backward_samples(call.args, embed, begin, end, Scratch(bytes).get());
    });
  }
  call.args.grad_out = embed.grad_samples;
  call.args.narrow = false;
  return polar_backward(call, wanted);
}

template <typename T>
auto backward(PolarCall<T>&& call, const Tensor& grad_out_, const Tensor& weight_,
              const PolarWanted& wanted, bool weight_grad) {
  check_weight(call, weight_);
  const Tensor grad_out = torch::stable::contiguous(grad_out_);
  const Tensor weight = parameter(call, weight_);
  PolarSampleArgs<T>& args = call.args;
  args.tokens = true;
  args.bands = 1;
  PolarEmbedArgs<T> embed{};
  embed.features = weight.size(0);
  STD_TORCH_CHECK(grad_out.sizes().vec() == output_sizes(call, embed.features) &&
                      grad_out.scalar_type() == call.output_type(),
                  "polar_embed_backward: grad_out must look like the output");
  args.grad_out = grad_out.const_data_ptr();
  const Sizes none = {0};
  Tensor grad_weight = torch::stable::new_empty(call.radii, none), grad_bias = grad_weight;
  if (weight_grad) {
    std::tie(grad_weight, grad_bias) = weight_gradients(call, embed);
  }
  const bool sampling = wanted.image || wanted.lens || wanted.offsets;
  const PolarGradients grads =
      sampling ? sampling_gradients(call, embed, weight, wanted) : PolarGradients(call);
  return std::tuple_cat(grads.tuple(), std::tuple(grad_weight, grad_bias));
}

Tensor polar_embed(const Sampling& sampling, const Tensor& weight, std::optional<Tensor> bias) {
  return with_polar_call(sampling,
                         [&](auto&& call) { return forward(std::move(call), weight, bias); });
}

auto polar_embed_backward(const Sampling& sampling, const Tensor& weight, const Tensor& grad_out,
                          bool image_grad, bool lens_grad, bool offsets_grad, bool weight_grad) {
  return with_polar_call(sampling, [&](auto&& call) {
    return backward(std::move(call), grad_out, weight, {image_grad, lens_grad, offsets_grad},
                    weight_grad);
  });
}

}  // namespace
}  // namespace darswin

STABLE_TORCH_LIBRARY_IMPL(darswin, CPU, m) {
  using namespace darswin;
  m.impl("polar_embed", TORCH_BOX(&Listed<polar_embed>::call));
  m.impl("polar_embed_backward", TORCH_BOX(&Listed<polar_embed_backward>::call));
}
