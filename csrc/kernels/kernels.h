// The kernels of one tier. Files of this folder are compiled once per tier with that tier's flags:
// no torch headers, no STL, no statics, everything else in an unnamed namespace.
#pragma once

#include "../dispatch.h"

namespace darswin::TIER {

void polar_sample(const PolarSampleArgs<float>&, int64_t begin, int64_t end);
void polar_sample(const PolarSampleArgs<double>&, int64_t begin, int64_t end);
void polar_sample_backward(const PolarSampleArgs<float>&, int64_t begin, int64_t end);
void polar_sample_backward(const PolarSampleArgs<double>&, int64_t begin, int64_t end);

int64_t window_attention_scratch(const WindowAttentionArgs<float>&);
void window_attention(const WindowAttentionArgs<float>&, int64_t begin, int64_t end, void* scratch);
void window_attention_backward(const WindowAttentionArgs<float>&, int64_t begin, int64_t end,
                               void* scratch);
int64_t window_attention_scratch(const WindowAttentionArgs<double>&);
void window_attention(const WindowAttentionArgs<double>&, int64_t begin, int64_t end,
                      void* scratch);
void window_attention_backward(const WindowAttentionArgs<double>&, int64_t begin, int64_t end,
                               void* scratch);
int64_t window_attention_scratch(const WindowAttentionArgs<bfloat16>&);
void window_attention(const WindowAttentionArgs<bfloat16>&, int64_t begin, int64_t end,
                      void* scratch);
void window_attention_backward(const WindowAttentionArgs<bfloat16>&, int64_t begin, int64_t end,
                               void* scratch);

}  // namespace darswin::TIER
