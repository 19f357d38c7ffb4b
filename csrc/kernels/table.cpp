// One tier's table of kernels; TIER names the namespace and the tier.
#include "kernels.h"

#define STRINGIZE_(x) #x
#define STRINGIZE(x) STRINGIZE_(x)

namespace darswin::TIER {

extern const Kernels kernels;
constexpr Kernels kernels = {
    STRINGIZE(TIER), {polar_sample, polar_sample_backward}, {polar_sample, polar_sample_backward},
              {window_attention_scratch, window_attention, window_attention_backward},
              {window_attention_scratch, window_attention, window_attention_backward},
              {window_attention_scratch, window_attention, window_attention_backward},
};

}  // namespace darswin::TIER
