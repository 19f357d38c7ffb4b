// The kernels of one tier. Files of this folder are compiled once per tier with that tier's flags:
// no torch headers, no STL, no statics, everything else in an unnamed namespace.
#pragma once

#include "../dispatch.h"

namespace darswin::TIER {

void directions(const double* angles, int64_t n, double* cosines, double* sines);
int64_t polar_sample_scratch(const PolarSampleArgs<float>&, PolarPass);
int64_t polar_sample_scratch(const PolarSampleArgs<double>&, PolarPass);
void polar_sample(const PolarSampleArgs<float>&, int64_t, int64_t, void* scratch);
void polar_sample(const PolarSampleArgs<double>&, int64_t, int64_t, void* scratch);
void polar_sample_backward_image(const PolarSampleArgs<float>&, int64_t, int64_t, void* scratch);
void polar_sample_backward_image(const PolarSampleArgs<double>&, int64_t, int64_t, void* scratch);
void polar_sample_backward_lens(const PolarSampleArgs<float>&, int64_t, int64_t, void* scratch);
void polar_sample_backward_lens(const PolarSampleArgs<double>&, int64_t, int64_t, void* scratch);

void transpose(const float*, int64_t rows, int64_t columns, float* to, int64_t to_stride);
int64_t polar_embed_scratch(const PolarSampleArgs<float>&, const PolarEmbedArgs<float>&, PolarPass);
void polar_embed(const PolarSampleArgs<float>&, const PolarEmbedArgs<float>&, int64_t, int64_t,
                 void* scratch);
void polar_embed_backward_weight(const PolarSampleArgs<float>&, const PolarEmbedArgs<float>&,
                                 int64_t, int64_t, float* weight, double* bias, void* scratch);
void polar_embed_backward_samples(const PolarSampleArgs<float>&, const PolarEmbedArgs<float>&,
                                  int64_t, int64_t, void* scratch);
void polar_embed_backward_image(const PolarSampleArgs<float>&, const PolarEmbedArgs<float>&,
                                int64_t, int64_t, void* scratch);
void transpose(const double*, int64_t rows, int64_t columns, double* to, int64_t to_stride);
int64_t polar_embed_scratch(const PolarSampleArgs<double>&, const PolarEmbedArgs<double>&,
                            PolarPass);
void polar_embed(const PolarSampleArgs<double>&, const PolarEmbedArgs<double>&, int64_t, int64_t,
                 void* scratch);
void polar_embed_backward_weight(const PolarSampleArgs<double>&, const PolarEmbedArgs<double>&,
                                 int64_t, int64_t, double* weight, double* bias, void* scratch);
void polar_embed_backward_samples(const PolarSampleArgs<double>&, const PolarEmbedArgs<double>&,
                                  int64_t, int64_t, void* scratch);
void polar_embed_backward_image(const PolarSampleArgs<double>&, const PolarEmbedArgs<double>&,
                                int64_t, int64_t, void* scratch);

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

void add_norm(const AddNormArgs<float>&, int64_t begin, int64_t end);
void add_norm(const AddNormArgs<bfloat16>&, int64_t begin, int64_t end);

void transpose_sum(const TransposeSumArgs&, int64_t begin, int64_t end);

}  // namespace darswin::TIER
