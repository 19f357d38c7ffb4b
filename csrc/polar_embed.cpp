// polar_embed and its backward on CPU: allocate, thread, call the kernel.
#include <tuple>
#include <vector>

#include "kernels/vector.h"
#include "polar_call.h"

namespace darswin {
namespace {

// Returns a weight (D, S_r * S_phi * C) or a bias (D,), contiguous and in the type used for
// computing.
template <typename T>
Tensor parameter(const Tensor& value) {
  const ScalarType type = value.scalar_type();
  const bool same = type == type_of<T>();
  const bool narrow = type == ScalarType::BFloat16 && sizeof(T) == sizeof(float);
  STD_TORCH_CHECK(value.is_cpu() && (same || narrow),
                  "polar_embed: wrong type or device of weight or bias");
  return as_contiguous(same ? value : torch::stable::to(value, type_of<T>()));
}

template <typename T>
Tensor checked_weight(const PolarCall<T>& call, const Tensor& weight) {
  STD_TORCH_CHECK(weight.dim() == 2 && weight.size(1) == call.token_size(),
                  "polar_embed: weight does not fit the samples of a token");
  return parameter<T>(weight);
}

template <typename T>
Sizes output_sizes(const PolarCall<T>& call, int64_t features) {
  return {call.batch, call.rings(), call.sectors(), features};
}

// Transposes (rows, columns) -> (columns, to_stride), in squares of four by four in registers.
template <typename T>
void transpose(const T* from, int64_t rows, int64_t columns, T* to, int64_t to_stride) {
  using V = Vector<T, 4>;
  const int64_t whole_rows = rows / 4 * 4, whole_columns = columns / 4 * 4;
  for (int64_t i = 0; i < whole_rows; i += 4) {
    for (int64_t j = 0; j < whole_columns; j += 4) {
      const T* block = from + i * columns + j;
      transpose4(load<V>(block), load<V>(block + columns), load<V>(block + 2 * columns),
                 load<V>(block + 3 * columns), to + j * to_stride + i, to_stride);
    }
  }
  for (int64_t i = 0; i < rows; ++i) {
    for (int64_t j = i < whole_rows ? whole_columns : 0; j < columns; ++j) {
      to[j * to_stride + i] = from[i * columns + j];
    }
  }
}

// Returns the number of threads that the work of forward is worth.
template <typename T>
int64_t count_threads(const PolarCall<T>& call, int64_t features) {
  constexpr double kPerMicrosecond = 5e4;  // multiply-adds, on a CPU with AVX2
  const double tokens = static_cast<double>(call.batch) * call.rings() * call.sectors();
  const double products = tokens * call.token_size() * features;
  return threads_for(call.microseconds() + products / kPerMicrosecond);
}

template <typename T>
Tensor forward(PolarCall<T>& call, Tensor weight, MaybeTensor bias) {
  const auto& kernel = kernels<PolarEmbedKernels<T>>();
  PolarSampleArgs<T>& args = call.args;
  args.tokens = true;
  weight = checked_weight(call, weight);
  PolarEmbedArgs<T> embed{.features = weight.size(0)};
  if (bias) {
    bias = parameter<T>(*bias);
    STD_TORCH_CHECK(bias->dim() == 1 && bias->size(0) == embed.features,
                    "polar_embed: bias does not fit the weight");
    embed.bias = pointer<T>(*bias);
  }
  const Tensor out = new_tensor(output_sizes(call, embed.features), call.output_type());
  if (out.numel() == 0) return out;
  args.out = out.mutable_data_ptr();
  const int64_t depth = call.token_size(), wide = round_up(embed.features, kRowUnit);
  std::vector<T> transposed(depth * wide);
  transpose(pointer<T>(weight), embed.features, depth, transposed.data(), wide);
  embed.transposed = transposed.data();
  run_with_scratch(call.batch * call.rings(), count_threads(call, embed.features),
                   kernel.scratch(args, embed, PolarPass::forward),
                   [&](auto... range) { kernel.forward(args, embed, range...); });
  return out;
}

// Up to this many tokens are summed one by one. Longer sums add up such partial sums, because the
// rounding error of a sum grows with its length.
constexpr int64_t kRunTokens = 1024;

// Returns the gradients of weight and bias. Each chunk of items has its own sums, which are added
// in order. The number of chunks does not depend on the number of threads, so the result does not
// either.
template <typename T>
std::tuple<Tensor, Tensor> weight_gradients(const PolarCall<T>& call,
                                            const PolarEmbedArgs<T>& embed) {
  const auto& kernel = kernels<PolarEmbedKernels<T>>();
  const int64_t depth = call.token_size(), row = round_up(depth, kRowUnit),
                features = embed.features;
  const int64_t items = call.points() ? call.batch * call.rings() : 0;
  const int64_t chunks = std::min<int64_t>(items, 16);
  std::vector<T> weights(chunks * features * row);
  std::vector<double> biases(chunks * features);
  const auto add_chunks = [&](int64_t begin, int64_t end, void* scratch) {
    const int64_t run = std::max<int64_t>(1, kRunTokens / call.sectors());
    std::vector<T> part;
    for (int64_t chunk = begin; chunk < end; ++chunk) {
      T* sums = weights.data() + chunk * features * row;
      double* bias = biases.data() + chunk * features;
      const int64_t first = items * chunk / chunks, last = items * (chunk + 1) / chunks;
      kernel.backward_weight(call.args, embed, first, std::min(first + run, last), sums, bias,
                             scratch);
      for (int64_t item = first + run; item < last; item += run) {
        part.assign(features * row, T(0));
        kernel.backward_weight(call.args, embed, item, std::min(item + run, last), part.data(),
                               bias, scratch);
        for (size_t k = 0; k < part.size(); ++k) sums[k] += part[k];
      }
    }
  };
  const int64_t threads = count_threads(call, features);
  run_with_scratch(chunks, threads, kernel.scratch(call.args, embed, PolarPass::forward),
                   add_chunks);
  const Tensor weight = new_tensor(Sizes{features, depth}, type_of<T>());
  const Tensor bias = new_tensor(Sizes{features}, type_of<T>());
  T *to_weight = mutable_pointer<T>(weight), *to_bias = mutable_pointer<T>(bias);
  parallel_ranges(features, threads, [&](int64_t begin, int64_t end) {
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

// Returns the gradients of image and lens, computed from the gradients of the samples.
template <typename T>
PolarGradients sampling_gradients(PolarCall<T>& call, PolarEmbedArgs<T>& embed,
                                  const Tensor& weight, const PolarWanted& wanted) {
  const auto& kernel = kernels<PolarEmbedKernels<T>>();
  const int64_t depth = call.token_size(), images = call.sampled_images();
  const Tensor rows = torch::stable::pad(weight, Sizes{0, round_up(depth, kRowUnit) - depth});
  embed.weight = pointer<T>(rows);
  const int64_t threads = count_threads(call, embed.features);
  if (!wanted.lens && !wanted.offsets && call.count_bands() == 1) {
    PolarGradients grads = call.no_gradients();
    grads.image = call.new_image_gradient();
    call.args.bands = 1;
    if (images > 0 && grads.image.numel() > 0) {
      run_with_scratch(images, threads, kernel.scratch(call.args, embed, PolarPass::backward_image),
                       [&](auto... range) { kernel.backward_image(call.args, embed, range...); });
    }
    return grads;
  }
  const Tensor grad_samples = new_tensor(output_sizes(call, depth), type_of<T>());
  embed.grad_samples = mutable_pointer<T>(grad_samples);
  run_with_scratch(images * call.rings(), threads,
                   kernel.scratch(call.args, embed, PolarPass::backward_samples),
                   [&](auto... range) { kernel.backward_samples(call.args, embed, range...); });
  call.args.grad_out = embed.grad_samples;
  call.args.narrow = false;
  return call.backward(wanted);
}

template <typename T>
auto backward(PolarCall<T>& call, Tensor weight, Tensor grad, bool image_grad, bool lens_grad,
              bool offsets_grad, bool weight_grad) {
  weight = checked_weight(call, weight);
  PolarEmbedArgs<T> embed{.features = weight.size(0)};
  grad =
      checked_gradient(grad, output_sizes(call, embed.features), call.output_type(), "polar_embed");
  call.args.tokens = true;
  call.args.bands = 1;
  call.args.grad_out = grad.const_data_ptr();
  Tensor grad_weight = no_gradient(type_of<T>()), grad_bias = no_gradient(type_of<T>());
  if (weight_grad) std::tie(grad_weight, grad_bias) = weight_gradients(call, embed);
  const PolarWanted wanted{image_grad, lens_grad, offsets_grad};
  const bool sampling = image_grad || lens_grad || offsets_grad;
  const PolarGradients grads =
      sampling ? sampling_gradients(call, embed, weight, wanted) : call.no_gradients();
  return std::tuple_cat(grads.tuple(), std::tuple(grad_weight, grad_bias));
}

using Forward = Listed<forward<float>, forward<double>>;
using Backward = Listed<backward<float>, backward<double>>;

}  // namespace
}  // namespace darswin

STABLE_TORCH_LIBRARY_IMPL(darswin, CPU, m) {
  m.impl("polar_embed", TORCH_BOX(&darswin::Forward::call));
  m.impl("polar_embed_backward", TORCH_BOX(&darswin::Backward::call));
}
