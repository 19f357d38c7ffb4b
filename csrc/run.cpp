// _run on CPU: a whole network, or a part of one, as one operator. core/network.h describes its
// programs. For a small network, the Python calls of its layers take longer than their arithmetic.
#include <vector>

#include "checks.h"
#include "core/network.h"

namespace darswin {
namespace {

std::vector<Tensor> run(std::vector<Tensor> inputs, Tensor weights, Sizes program) {
  STD_TORCH_CHECK(weights.is_cpu() && weights.scalar_type() == ScalarType::Int &&
                      weights.is_contiguous() && !inputs.empty() && inputs[0].dim() > 0,
                  "_run: the weights must be contiguous int32, and the first input (B, ...)");
  const Network network(std::move(program), pointer<uint32_t>(weights), weights.numel());
  const int64_t batch = inputs[0].size(0);
  STD_TORCH_CHECK(network.input_count() == static_cast<int64_t>(inputs.size()),
                  "_run: the program has another number of inputs");
  std::vector<Input> given;
  for (size_t k = 0; k < inputs.size(); ++k) {
    Tensor& x = inputs[k];
    STD_TORCH_CHECK(x.is_cpu() && x.scalar_type() == ScalarType::Float && x.dim() > 0 &&
                        (x.size(0) == 1 || x.size(0) == batch) &&
                        x.numel() == x.size(0) * network.input_numbers(k),
                    "_run: an input has a wrong type, device or shape");
    x = as_contiguous(x);
    given.push_back({pointer<float>(x), x.size(0)});
  }
  std::vector<Tensor> outputs;
  std::vector<float*> results;
  for (int64_t k = 0; k < network.output_count(); ++k) {
    Sizes sizes = network.output_shape(k);
    sizes.insert(sizes.begin(), batch);
    outputs.push_back(new_tensor(sizes, ScalarType::Float));
    ask_for_large_pages(outputs.back());
    results.push_back(mutable_pointer<float>(outputs.back()));
  }
  network.run(batch, given.data(), results.data());
  return outputs;
}

}  // namespace
}  // namespace darswin

STABLE_TORCH_LIBRARY_IMPL(darswin, CPU, m) { m.impl("_run", TORCH_BOX(&darswin::run)); }
