#include "parallel.h"

namespace darswin {
namespace {

thread_local int64_t limit = 0;  // 0: none

}  // namespace

int64_t (*thread_setting)() = [] { return int64_t{1}; };

int64_t num_threads() { return limit > 0 ? limit : thread_setting(); }

ThreadLimit::ThreadLimit(int64_t threads) : before(limit) { limit = threads; }
ThreadLimit::~ThreadLimit() { limit = before; }

}  // namespace darswin
