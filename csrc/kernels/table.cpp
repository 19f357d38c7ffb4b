// One tier's table of kernels; TIER names the namespace and the tier.
#include "kernels.h"

#define STRINGIZE_(x) #x
#define STRINGIZE(x) STRINGIZE_(x)

namespace darswin::TIER {

extern const Kernels kernels;
constexpr Kernels kernels = {
    STRINGIZE(TIER),
        {directions, polar_sample_scratch, polar_sample, polar_sample_backward_image,
         polar_sample_backward_lens, transpose, polar_embed_scratch, polar_embed,
         polar_embed_backward_weight, polar_embed_backward_samples, polar_embed_backward_image},
        {directions, polar_sample_scratch, polar_sample, polar_sample_backward_image,
         polar_sample_backward_lens, transpose, polar_embed_scratch, polar_embed,
         polar_embed_backward_weight, polar_embed_backward_samples, polar_embed_backward_image},
        {window_attention_scratch, window_attention, window_attention_backward},
        {window_attention_scratch, window_attention, window_attention_backward},
        {window_attention_scratch, window_attention, window_attention_backward}, add_norm, add_norm,
        transpose_sum,
};

}  // namespace darswin::TIER
